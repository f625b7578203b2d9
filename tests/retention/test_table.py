"""What a row says of a stream: shown, not shown with what could be there, or absent below a stated bound."""

import csv
import io
import json
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.retention import RetentionTable, retention_table
from probe_kit.retention.columns.text import exceeds_text, verdict_text
from probe_kit.train import ArrayRun, ControlComparison, Controls, load_results, save_results

ProbedRun = Callable[..., ArrayRun]

SIGNAL = ([0.5, 0.9, 0.7], [[0.6, 0.7]])
WEAK = ([0.5, 0.8, 0.6], [[0.5, 0.8]])
NONE = ([0.5, 0.55, 0.5], [[0.58, 0.5]])
CONTRACT_KEYS = {
    "run": {"model", "mode", "suite"},
    "success": {
        "n_episodes", "n_items", "sr", "sr_original", "sr_swapped", "share_wrong", "share_outside",
        "chance_margin_episodes", "regime",
    },
    "backbone": {"score", "ci", "peak", "at_most", "verdict", "site", "layer", "ties", "p_fwe", "exceeds"},
    "action": {"score", "ci", "peak", "at_most", "verdict", "site", "layer", "ties", "iteration", "first_peak"},
    "retention": {"value", "ci", "published", "defined", "note"},
    "controls": {"missing", "probe_minus_sr", "n_groups"},
}  # fmt: skip
FORMER_KEYS = {"accuracy", "debiased", "bounded", "area", "beats", "plain"}
"""A key that changed its meaning would be read as before."""


@pytest.fixture
def table(probed_run: ProbedRun) -> RetentionTable:
    return retention_table([probed_run({"color": SIGNAL, "shape": WEAK, "counting": NONE})])


def test_a_row_joins_behaviour_peaks_and_retention(table: RetentionTable) -> None:
    row = table.rows[0]
    assert (row.category, row.view, row.success.n_episodes, row.success.n_items, row.controls.n_groups) == (
        "color",
        "mean",
        200,
        100,
        100,
    )
    assert (row.success.sr, row.success.share_wrong, row.success.share_outside) == (0.6, 0.3, 0.1)
    assert (row.backbone.peak, row.backbone.layer, row.backbone.depth) == (pytest.approx(0.9), 1, 0.5)
    assert (row.action.peak, row.action.layer, row.action.iteration) == (pytest.approx(0.7), 1, 0)
    assert (row.backbone.site, row.action.site) == ("backbone.01.residual", "expert.01.residual@0")
    assert (row.backbone.score, row.backbone.verdict) == (pytest.approx(0.9), "shown")
    assert row.action.score is not None
    assert 0.6 < row.action.score <= 0.7
    assert row.retention.published == pytest.approx(0.5)
    assert row.retention.value == pytest.approx((row.action.score - 0.5) / 0.4)
    assert row.controls.probe_minus_sr == pytest.approx(0.3)
    assert row.controls.missing == {"left": 0, "right": 0}


def test_retention_of_the_mean_is_the_ratio_of_the_two_columns_beside_it(table: RetentionTable) -> None:
    """Over all probed categories: leaving out those without signal would choose lucky backbones."""
    (mean,) = table.means
    for part in ("backbone", "action"):
        category_scores = [getattr(row, part).score for row in table.rows]
        assert getattr(mean, part).score == pytest.approx(sum(category_scores) / 3)
    assert mean.retention.value == pytest.approx((mean.action.score - 0.5) / (mean.backbone.score - 0.5))  # type: ignore[operator]
    assert mean.categories == ("color", "shape", "counting")


def test_the_published_mean_averages_ratios_and_names_the_categories_left_out(table: RetentionTable) -> None:
    (mean,) = table.means
    assert mean.retention.published == pytest.approx((0.2 / 0.4 + 0.3 / 0.3) / 2)
    assert mean.backbone.peak == pytest.approx((0.9 + 0.8 + 0.55) / 3)
    assert mean.left_out == ("counting",)
    assert mean.retention.note == "published ratios without counting"


def test_other_categories_change_no_number_of_a_category(probed_run: ProbedRun) -> None:
    alone = retention_table([probed_run({"color": SIGNAL}, "alone")]).rows[0]
    among = retention_table([probed_run({"shape": WEAK, "counting": NONE, "color": SIGNAL}, "among")]).rows[2]
    assert (among.backbone, among.action, among.retention) == (alone.backbone, alone.action, alone.retention)
    assert among.success == alone.success


def test_an_undefined_ratio_stays_in_the_machine_readable_output(table: RetentionTable) -> None:
    row = json.loads(table.to_json())[2]
    assert row["retention"]["published"] == pytest.approx(0.08 / 0.05)
    assert row["retention"]["defined"] is False
    most = 100 * row["backbone"]["at_most"]
    assert row["retention"]["note"] == f"n/a (backbone absent, at most {most:.0f} %)"


def test_json_rows_have_the_keys_of_the_contract(table: RetentionTable) -> None:
    rows = json.loads(table.to_json())
    assert [row["category"] for row in rows] == ["color", "shape", "counting", "mean"]
    assert all({"category", "view"} <= set(row) for row in rows)
    for part, keys in CONTRACT_KEYS.items():
        assert all(set(row[part]) >= keys for row in rows), part
        assert not any(FORMER_KEYS & set(row[part]) for row in rows), part


def test_csv_has_one_line_per_row_and_numbers_in_every_interval_column(table: RetentionTable) -> None:
    rows = list(csv.DictReader(io.StringIO(table.to_csv())))
    assert len(rows) == 4
    assert float(rows[0]["retention.ci_low"]) < float(rows[0]["retention.ci_high"])
    assert rows[0]["backbone.layer"] == "1"
    assert rows[3]["categories"] == "color shape counting"


def test_a_run_without_activations_shows_success_rates_only(probed_run: ProbedRun) -> None:
    probed = probed_run({"color": SIGNAL})
    scripted = ArrayRun(probed.path.parent / "scripted", "expert", probed.suite, probed.episodes, {})
    (row,) = retention_table([scripted]).rows
    assert (row.success.sr, row.view, row.backbone.score, row.retention.note) == (
        0.6,
        None,
        None,
        "n/a (no probes)",
    )


def test_runs_are_never_averaged_with_each_other(probed_run: ProbedRun) -> None:
    first = probed_run({"color": SIGNAL}, "pi0")
    second = probed_run({"color": WEAK}, "smolvla", suite="other@1#ba9876543210")
    means = retention_table([first, second]).means
    assert [(mean.run.model, mean.run.suite) for mean in means] == [
        ("pi0", first.suite),
        ("smolvla", second.suite),
    ]
    assert [mean.retention.published for mean in means] == pytest.approx([0.5, 1.0])


def test_views_and_keys_that_are_not_there_are_errors(probed_run: ProbedRun) -> None:
    run = probed_run({"color": SIGNAL})
    with pytest.raises(UnknownSiteError, match="has probes of mean, not of last"):
        retention_table([run], views=["last"])
    with pytest.raises(UsageError, match="no probe results"):
        retention_table([run], keys=["ffffffffffff"])


UNDEFINED = ([0.5, 0.5, 0.5], [[0.54, 0.5]])


@pytest.mark.slow
def test_undefined_is_nan_in_every_frame_and_shares_stay_floats(probed_run: ProbedRun) -> None:
    """An SR that happens to be 0 or 1 everywhere is no integer, and a ratio without meaning no number."""
    probed = probed_run({"color": SIGNAL, "counting": NONE, "shape": UNDEFINED})
    episodes = probed.episodes.assign(outcome="oob", side_placed="none")
    bare = ArrayRun(probed.path.parent / "bare", "expert", probed.suite, episodes, {})
    table = retention_table({"probed": [probed], "bare": [bare]})
    pair = retention_table({"a": [probed], "b": [probed_run({"color": SIGNAL, "counting": NONE}, "other")]})
    for frame in (table.to_frame(), retention_table([bare]).to_frame(), pair.differences_frame()):
        floats = [
            name
            for name in frame
            if any(part in f".{name}" for part in FLOATS)
            and "defined" not in str(name)
            and "exceeds" not in str(name)
            and not str(name).endswith((".n", ".n_minus"))
        ]
        assert floats
        assert {str(frame[name].dtype) for name in floats if name not in TEXTS} == {"float64"}
    assert {str(frame[name].dtype) for name in frame if str(name).endswith((".n", ".n_minus"))} == {"Int64"}
    assert {"sr_models.ci_low", "retention_models.ci_high"} <= set(frame), "also where no models are compared"
    frame = table.to_frame()
    undefined = frame[~frame["retention.defined"]]
    assert len(undefined) == 2 + 4, "two categories without signal, and the run without probes"
    for name in ("retention.published", "retention.value", "retention.ci_low", "retention.ci_high"):
        assert undefined[name].map(math.isnan).all(), name
        assert frame[name].notna().any()
    assert math.isnan(frame["success.chance_margin_episodes"][3]), "a mean has none"
    raw = [row["retention"]["published"] for row in json.loads(table.to_json())["rows"][:3]]
    assert raw[1] == pytest.approx(0.08 / 0.05), "json keeps the raw ratio"


FLOATS = (
    ".sr",
    "margin",
    "accuracy",
    ".score",
    ".peak",
    "at_most",
    "ci_",
    "_ci_",
    "retention.",
    "share_",
    "depth",
    "minus",
    "chance",
    "p_fwe",
)
TEXTS = ("retention.note", "retention.reason", "answers.score", "minus", "minus_run", "only_minus")


def test_the_first_iteration_stands_beside_the_best(probed_run: ProbedRun) -> None:
    """Late iterations hold the decision itself as a noisy action; the first sees pure noise."""
    table = retention_table([probed_run({"color": ([0.5, 0.9], [[0.6, 0.8], [0.55, 0.95]])})])
    row, mean = table.all_rows
    assert row.action.first_peak == 0.8
    assert row.action.peak == pytest.approx(0.95)
    assert (row.run.call, mean.run.call) == (0, 0)
    assert mean.action.first_peak == row.action.first_peak


@pytest.fixture
def table_category_mean(probed_run: Callable[..., ArrayRun]) -> RetentionTable:
    return retention_table([probed_run({"color": SIGNAL, "shape": SIGNAL, "counting": NONE})])


def test_the_mean_of_categories_is_known_better_than_one_of_them(table_category_mean: RetentionTable) -> None:
    (mean,) = table_category_mean.means
    for part in ("success", "backbone", "action"):
        widths = [limits[1] - limits[0] for row in table_category_mean.rows for limits in [getattr(row, part).ci]]
        low, high = getattr(mean, part).ci
        assert high - low == pytest.approx(np.sqrt(np.mean(np.square(widths)) / 3), rel=0.15)
    assert mean.success.ci is not None
    assert mean.success.ci[0] < mean.success.sr < mean.success.ci[1]


def test_mean_retention_is_over_all_categories_and_known_better_than_one_of_them(
    table_category_mean: RetentionTable,
) -> None:
    (mean,) = table_category_mean.means
    assert mean.left_out == ("counting",), "of the published ratios"
    scores = [[part.score - 0.5 for part in (row.action, row.backbone)] for row in table_category_mean.rows]
    assert mean.retention.value == pytest.approx(np.divide(*np.mean(scores, axis=0)))
    low, high = mean.retention.ci
    of_one = table_category_mean.rows[0].retention.ci
    assert low < mean.retention.value < high
    assert high - low < of_one[1] - of_one[0]


def test_a_mean_has_limits_where_a_category_of_it_has_none(table_category_mean: RetentionTable) -> None:
    """The mean backbone is known well enough to divide by."""
    assert table_category_mean.rows[2].retention.ci == (None, None)
    assert None not in table_category_mean.means[0].retention.ci


def test_the_mean_of_one_category_is_that_category(probed_run: Callable[..., ArrayRun]) -> None:
    row, mean = retention_table([probed_run({"color": SIGNAL})]).all_rows
    assert mean.retention.value == row.retention.value
    assert mean.retention.published == row.retention.published
    for part in ("success", "backbone", "action", "retention"):
        assert getattr(mean, part).ci == pytest.approx(getattr(row, part).ci), part


def test_selectivity_is_the_peak_above_the_permuted_probes(table_category_mean: RetentionTable) -> None:
    row = json.loads(table_category_mean.to_json())[0]
    assert row["backbone"]["selectivity"] == pytest.approx(0.9 - 0.5)  # the fixture's null is centred on one half
    assert row["action"]["selectivity"] == pytest.approx(0.7 - 0.5)


def held_against(run: ArrayRun, p: float, control: str = "random-features") -> ArrayRun:
    """The run with every site compared with a control."""
    results = load_results(run)
    comparisons = [
        ControlComparison(control, category, view, str(site), 0.8, p)
        for (category, view), curve in results.curves.items()
        for site in curve.sites
    ]
    save_results(replace(results, controls=Controls().with_scores([], comparisons)), run.path)
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
