"""What a row says of a stream: shown, not shown with what could be there, or absent below a stated bound."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.columns.text import exceeds_text, verdict_text
from probe_kit.train import ArrayRun, ControlComparison, Controls, load_results, save_results

ProbedRun = Callable[..., ArrayRun]
SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7]])
NONE = ([0.5, 0.55, 0.5], [[0.58, 0.5]])


def held_against(run: ArrayRun, p: float, control: str = "random-features") -> ArrayRun:
    """The run with every site compared with a control."""
    results = load_results(run)
    found = [
        ControlComparison(control, category, view, str(site), 0.8, p)
        for (category, view), curve in results.curves.items()
        for site in curve.sites
    ]
    save_results(replace(results, controls=Controls().with_scores([], found)), run.path)
    return run


def test_a_signal_is_shown_and_none_is_absent_where_it_could_be_no_more_than_the_bound(
    probed_run: ProbedRun,
) -> None:
    color, counting = retention_table([probed_run({"color": SIGNAL, "counting": NONE})]).rows
    assert (color.backbone.verdict, verdict_text(color.backbone)) == ("shown", "shown")
    most = counting.backbone.at_most
    assert most is not None
    assert 0.58 < most < 0.65
    assert (counting.backbone.verdict, verdict_text(counting.backbone)) == (
        "absent",
        f"absent (at most {100 * most:.0f} %)",
    )


def test_with_a_lower_bound_the_same_is_not_shown(probed_run: ProbedRun) -> None:
    run = probed_run({"counting": NONE})
    part = retention_table([run], absent_below=0.6).rows[0].backbone
    assert part.verdict == "not shown"
    assert verdict_text(part) == f"not shown (could be up to {100 * (part.at_most or 0):.0f} %)"
    assert retention_table([run], absent_below=0.6).rows[0].retention.note.startswith("n/a (backbone not shown")


def test_a_signal_that_is_not_shown_to_beat_a_control_is_not_absent(probed_run: ProbedRun) -> None:
    row = retention_table([held_against(probed_run({"color": SIGNAL}), 0.2)]).rows[0]
    assert row.backbone.at_most is not None
    assert 0.9 < row.backbone.at_most < 0.96
    assert (row.backbone.verdict, row.retention.defined) == ("not shown", False)
    assert verdict_text(row.backbone) == f"not shown (could be up to {100 * row.backbone.at_most:.0f} %)"
    assert exceeds_text(row.backbone) == "chance; not shown: random-features"
    assert row.retention.note == "n/a (backbone not shown to beat random-features)"
    better = retention_table([held_against(probed_run({"color": SIGNAL}, "better"), 0.01)]).rows[0]
    assert (better.backbone.verdict, better.retention.defined) == ("shown", True)
    assert exceeds_text(better.backbone) == "chance, random-features"


def test_without_a_control_the_table_says_that_none_was_run(probed_run: ProbedRun) -> None:
    color, counting = retention_table([probed_run({"color": SIGNAL, "counting": NONE})]).rows
    assert exceeds_text(color.backbone) == "chance (no control was run)"
    assert exceeds_text(counting.backbone) == "not shown: chance"


def test_every_format_shows_the_verdicts(probed_run: ProbedRun) -> None:
    table: RetentionTable = retention_table([held_against(probed_run({"color": SIGNAL, "counting": NONE}), 0.2)])
    color, counting = table.rows
    for words in (verdict_text(color.backbone), verdict_text(counting.backbone), "in the backbone"):
        assert words in table.to_markdown()
        assert words.replace("%", r"\%") in table.to_latex("all")
    frame = table.to_frame()
    assert frame["backbone.verdict"][0] == "not shown"
    assert frame["backbone.at_most"][0] == pytest.approx(color.backbone.at_most)
    assert not frame["backbone.exceeds.random-features"][0]
