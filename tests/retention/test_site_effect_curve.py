"""Readable, passes, read: what the figure shows is what is stored; and tables take the verdict from it."""

from collections.abc import Callable
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest

from probe_kit.errors import NoInterventionsError
from probe_kit.intervene.results.results import effects_csv
from probe_kit.intervene.store.answers import Answers, save
from probe_kit.intervene.store.settings import FORMAT, key_of
from probe_kit.retention import retention_table
from probe_kit.retention.displays import SiteEffectDisplay, collect_figures, site_effect_curve
from probe_kit.train import ArrayRun, load_results
from tests.intervene.answers import answers_of, follower, habit

mpl.use("agg")
SIGNAL = ([0.5, 0.9], [[0.7]])


def store(run: ArrayRun, kind: str, answers: Answers, **asked: str) -> None:
    categories = list(dict.fromkeys(answers.categories.tolist()))
    settings = {
        "format": FORMAT, "kind": kind, "run_settings": run.settings_sha256, "stamp": "", "wording": None,
        "categories": categories, **asked,
    }  # fmt: skip
    check = {"episodes": 0, "compared": 0, "equal": 0, "largest_difference": 0.0}
    save(run.location, settings, key_of(settings), answers, effects_csv(answers, run.suite), {"replay": check})


def inside(answers: Answers, condition: str = "|all", **shares: float) -> Answers:
    """shares: by place (`__` for `.`), how many of the episodes go where the exchange brings them."""
    count = answers.episodes.size
    rows = [
        np.where(np.arange(count) < share * count, answers.of("exchanged"), answers.of("plain"))
        for share in shares.values()
    ]
    lateral = np.vstack([answers.lateral, *rows])
    names = tuple(f"{name.replace('__', '.')}{condition}" for name in shares)
    return replace(
        answers,
        conditions=(*answers.conditions, *names),
        lateral=lateral,
        changed=np.abs(lateral - lateral[0]),
        ledger=np.zeros((*lateral.shape, 5)),
    )


@pytest.fixture
def run(probed_run: Callable[..., ArrayRun]) -> ArrayRun:
    """Color follows, shape does not; both can be read at layer 1."""
    made = probed_run({"color": SIGNAL, "shape": SIGNAL})
    answers = answers_of({"color": follower(48), "shape": habit(48)})
    store(made, "follow", answers)
    return made


def test_it_shows_accuracies_and_turned_episodes_by_layer(run: ArrayRun) -> None:
    answers = answers_of({"color": follower(48)})
    store(run, "interchange", inside(answers, backbone__00=1.0, backbone__01=0.0))
    display = SiteEffectDisplay.from_run(run, load_results(run), "color").plot()
    np.testing.assert_allclose(display.readable.percent, [50.0, 90.0])
    assert display.readable.significant.tolist() == [False, True]
    np.testing.assert_allclose(display.passes["all"].percent, [100.0, 0.0])
    assert display.passes["all"].significant.tolist() == [True, False]
    assert display.read is None
    assert display.ax_ is not None
    labels = [line.get_label() for line in display.ax_.get_lines()]
    assert "passes: all" in labels
    names = [exhibit.name for exhibit in collect_figures([run], retention_table([run]))]
    assert any("causes" in name for name in names)


def test_without_an_interchange_there_is_no_such_figure(run: ArrayRun) -> None:
    with pytest.raises(NoInterventionsError, match="--kind interchange"):
        SiteEffectDisplay.from_run(run, load_results(run), "color")
    with pytest.raises(NoInterventionsError):
        site_effect_curve(run, load_results(run))
    assert not any("causes" in exhibit.name for exhibit in collect_figures([run], retention_table([run])))


def test_tables_say_what_is_used_and_why(run: ArrayRun) -> None:
    rows = {row.category: row for row in retention_table([run]).rows}
    assert (rows["color"].image_swap.used, rows["shape"].image_swap.used) == ("used", "encoded, unused")
    assert rows["shape"].image_swap.used_note == "positive control: color"
    assert (rows["color"].image_swap.follows, rows["color"].image_swap.against) == (1.0, 0.0)


def test_where_nothing_carries_it_inside_nothing_is_called_used(run: ArrayRun) -> None:
    answers = answers_of({"color": follower(48)})
    store(run, "interchange", inside(answers, backbone__00=0.0, backbone__01=0.1))
    rows = {row.category: row for row in retention_table([run]).rows}
    assert rows["color"].image_swap.used == "inconclusive"
    assert rows["shape"].image_swap.used == "encoded, unused"


@pytest.mark.parametrize("is_memory_last", [False, True])
def test_a_memory_and_a_map_are_read_beside_each_other(run: ArrayRun, is_memory_last: bool) -> None:
    """Whichever was stored last took the other's place in verdict and figure."""
    answers = answers_of({"color": follower(48)})
    both = {
        "backbone.*": inside(answers, backbone__00=1.0, backbone__01=0.0),
        "memory.*": inside(answers, memory__00=1.0, memory__01=0.0),
    }
    for sites in sorted(both, reverse=not is_memory_last):
        store(run, "interchange", both[sites], sites=sites)
    (row,) = (row for row in retention_table([run]).rows if row.category == "color")
    assert (row.image_swap.used, row.image_swap.used_note) == ("used", "passes at backbone.00; read at memory.00")
    display = SiteEffectDisplay.from_run(run, load_results(run), "color")
    assert display.read is not None
    assert (display.passes["all"].percent.tolist(), display.read.percent.tolist()) == ([100, 0], [100, 0])


def test_a_direction_alone_is_no_search_and_no_map(run: ArrayRun) -> None:
    """It turned *used* into *inconclusive*, and stopped the report for want of a map to draw."""
    answers = answers_of({"color": follower(48)})
    along = inside(answers, "|image|mean-difference", backbone__01=0.0)
    store(run, "interchange", along, direction="mean-difference")
    (row,) = (row for row in retention_table([run]).rows if row.category == "color")
    assert (row.image_swap.used, row.image_swap.used_note) == ("used", "")
    assert not any("causes" in exhibit.name for exhibit in collect_figures([run], retention_table([run])))
    with pytest.raises(NoInterventionsError, match="--kind interchange"):
        site_effect_curve(run, load_results(run))
