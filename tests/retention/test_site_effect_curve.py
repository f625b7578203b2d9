"""Readable, passes, read: what the figure shows is what is stored; and tables take the verdict from it."""

from collections.abc import Callable
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest

from probe_kit.errors import NoInterventionsError
from probe_kit.intervene import UseVerdict
from probe_kit.intervene.outcomes import FORMAT, ConditionOutcomes
from probe_kit.retention import RetentionRow, retention_table
from probe_kit.retention.displays import SiteEffectDisplay, collect_figures, site_effect_curve
from probe_kit.train import ArrayRun, load_results
from tests.intervene.answers import follower, habit, outcomes_of, store_outcomes

mpl.use("agg")
SIGNAL = ([0.5, 0.9], [[0.7]])


def store(run: ArrayRun, kind: str, answers: ConditionOutcomes, **asked: str) -> None:
    categories = list(dict.fromkeys(answers.categories.tolist()))
    settings = {
        "format": FORMAT, "kind": kind, "run_settings": run.settings_sha256, "stamp": "", "wording": None,
        "categories": categories, **asked,
    }  # fmt: skip
    store_outcomes(run.location, run.suite, settings, answers)


def inside(answers: ConditionOutcomes, condition: str = "|all", **shares: float) -> ConditionOutcomes:
    """shares: by place (`__` for `.`), how many of the episodes go where the exchange brings them."""
    count = answers.episodes.size
    rows = [
        np.where(np.arange(count) < share * count, answers.of("image_swap"), answers.of("clean"))
        for share in shares.values()
    ]
    lateral = np.vstack([answers.displacement, *rows])
    names = tuple(f"{name.replace('__', '.')}{condition}" for name in shares)
    return replace(
        answers,
        conditions=(*answers.conditions, *names),
        displacement=lateral,
        max_action_change=np.abs(lateral - lateral[0]),
        edit_log=np.zeros((*lateral.shape, 5)),
    )


def used(row: RetentionRow) -> UseVerdict:
    assert row.image_swap.use is not None
    return row.image_swap.use


@pytest.fixture
def run(probed_run: Callable[..., ArrayRun]) -> ArrayRun:
    """Color follows, shape does not; both can be read at layer 1."""
    made = probed_run({"color": SIGNAL, "shape": SIGNAL})
    answers = outcomes_of({"color": follower(48), "shape": habit(48)})
    store(made, "image-swap", answers)
    return made


def test_it_shows_accuracies_and_turned_episodes_by_layer(run: ArrayRun) -> None:
    answers = outcomes_of({"color": follower(48)})
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
    assert {name: used(rows[name]).behaviour for name in ("color", "shape")} == {
        "color": "used", "shape": "not used",
    }  # fmt: skip
    assert used(rows["shape"]).reason.endswith("positive control: color")
    assert (rows["color"].image_swap.follow_rate, rows["color"].image_swap.reversal_rate) == (1.0, 0.0)


def test_where_nothing_carries_it_inside_the_place_is_open_and_the_behaviour_is_not(run: ArrayRun) -> None:
    answers = outcomes_of({"color": follower(48)})
    store(run, "interchange", inside(answers, backbone__00=0.0, backbone__01=0.1))
    rows = {row.category: row for row in retention_table([run]).rows}
    assert used(rows["color"]).behaviour == "used"
    assert used(rows["color"]).place == "no place that was tried carries half of it"
    assert used(rows["shape"]).behaviour == "not used"


@pytest.mark.parametrize("is_memory_last", [False, True])
def test_a_memory_and_a_map_are_read_beside_each_other(run: ArrayRun, is_memory_last: bool) -> None:
    """Whichever was stored last took the other's place in verdict and figure."""
    answers = outcomes_of({"color": follower(48)})
    both = {
        "backbone.*": inside(answers, backbone__00=1.0, backbone__01=1.0),
        "kv.*": inside(answers, kv__00=1.0, kv__01=0.0),
    }
    for sites in sorted(both, reverse=not is_memory_last):
        store(run, "interchange", both[sites], sites=sites)
    (row,) = (row for row in retention_table([run]).rows if row.category == "color")
    assert (used(row).behaviour, used(row).place) == ("used", "passes at backbone.01; read at kv.00")
    display = SiteEffectDisplay.from_run(run, load_results(run), "color")
    assert display.read is not None
    assert (display.passes["all"].percent.tolist(), display.read.percent.tolist()) == ([100, 100], [100, 0])


def test_the_tie_is_of_the_layers_at_which_a_probe_is_significant(run: ArrayRun) -> None:
    """Layer 1 is read by probes: unread if nothing passes there, read if the probe's direction carries it."""

    def tie() -> str:
        (row,) = (row for row in retention_table([run]).rows if row.category == "color")
        return used(row).tie

    assert tie() == "whether the readable copy is the one used was not tested"
    answers = outcomes_of({"color": follower(48)})
    store(run, "interchange", inside(answers, backbone__00=1.0, backbone__01=0.0), direction="none")
    assert tie() == "the readable copy is not the one used: the answer passes elsewhere"
    both = inside(inside(answers, "|all|probe", backbone__01=1.0), "|all|control-1", backbone__01=0.0)
    store(run, "interchange", both, direction="probe", seed="0")
    assert tie() == "the readable copy is read (backbone.01 all)"


def test_a_direction_alone_is_no_search_and_no_map(run: ArrayRun) -> None:
    """It turned *used* into *undecided*, and stopped the report for want of a map to draw."""
    answers = outcomes_of({"color": follower(48)})
    along = inside(answers, "|image|mean-difference", backbone__01=0.0)
    store(run, "interchange", along, direction="mean-difference")
    (row,) = (row for row in retention_table([run]).rows if row.category == "color")
    assert (used(row).behaviour, used(row).place) == ("used", "")
    assert not any("causes" in exhibit.name for exhibit in collect_figures([run], retention_table([run])))
    with pytest.raises(NoInterventionsError, match="--kind interchange"):
        site_effect_curve(run, load_results(run))
