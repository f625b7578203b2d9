"""Every interval that a table, a report or a figure shows, searched in many worlds."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import product
from math import isnan, sqrt
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from probe_kit.retention import (
    Difference,
    RetentionRow,
    RetentionTable,
    layer_curve,
    measure_retention,
    retention_table,
)
from probe_kit.retention.behaviour import success_share
from probe_kit.retention.displays import LayerCurveDisplay
from probe_kit.retention.estimators import PooledScores, Rate, curve_scores, limits
from probe_kit.statistics.crossfit import GroupSums, crossfit
from probe_kit.statistics.intervals import Share
from probe_kit.statistics.retention import Scores, accuracy_interval, retention, retention_difference
from probe_kit.train import ArrayRun, ProbeCurve, load_results
from probe_kit.train.controls import add_untrained
from tests.retention.conftest import runs_in
from tests.support.inner_qualities import stream_of
from tests.support.slow_cases import slow_but

ProbedRun = Callable[..., ArrayRun]
PERFECT = ([1.0, 1.0], [[1.0, 1.0]])
HOPELESS = ([0.0, 0.5], [[0.0, 0.5]])
GOOD = ([0.5, 0.9], [[0.6, 0.7]])
NONE = ([0.5, 0.52], [[0.5, 0.51]])
ITERATED = ([0.5, 0.8], [[0.6, 0.7], [0.75, 0.75]])
WORLDS = {
    "perfect": {"color": PERFECT},
    "perfect and good": {"color": PERFECT, "shape": GOOD},
    "perfect everywhere": {"color": PERFECT, "shape": PERFECT, "state": PERFECT},
    "hopeless": {"color": HOPELESS, "shape": NONE},
    "good": {"color": GOOD},
    "mixed": {"color": GOOD, "shape": NONE, "state": PERFECT, "time": ITERATED},
}
Found = tuple[str, float, float, float]

IN_DEFAULT = ("perfect and good", "hopeless", "mixed")


@pytest.fixture(scope="module", params=slow_but(IN_DEFAULT, WORLDS))
def table(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RetentionTable:
    """A run of the world against an equal one, and a group of two good ones."""
    world, probed_run = WORLDS[request.param], runs_in(tmp_path_factory.mktemp("world"))
    runs = {name: [probed_run(world, name)] for name in ("one", "again")}
    return retention_table(
        {**runs, "other": [probed_run(dict.fromkeys(world, GOOD), f"other{at}") for at in "ab"]}
    )


# -- every interval that there is ----------------------------------------------------------------------------

OF_PART = {
    "success": "sr", "backbone": "score", "action": "score", "retention": "value",
    "sr_models": "difference", "retention_models": "difference",
}  # fmt: skip
"""Whose interval `ci` of a part is."""


def intervals(rows: Sequence[RetentionRow] | Sequence[Difference]) -> Iterator[Found]:
    """Name, value and limits of every interval that has any; no limits are an answer of their own."""
    for row in rows:
        fields = asdict(row)
        parts = [("", fields), *((name, part) for name, part in fields.items() if isinstance(part, dict))]
        for part, inner in parts:
            for name, field_value in inner.items():
                if (
                    not (name == "ci" or name.endswith("_ci"))
                    or field_value is None
                    or field_value == (None, None)
                ):
                    continue
                of = OF_PART[part] if name == "ci" else name.removesuffix("_ci")
                yield f"{row.category} {part}.{name}", inner[of], *field_value


def of_probes(table: RetentionTable) -> Iterator[Found]:
    for results in table.results.values():
        for row in results.scores.itertuples():
            yield f"scores {row.category} {row.site}", row.accuracy, row.ci_low, row.ci_high
        for line in (
            line
            for category in results.settings.categories
            for stream in LayerCurveDisplay.from_results(results, category).streams
            for line in stream.lines
        ):
            for at, value in enumerate(line.score):
                yield f"curve, layer {at}", value, line.low[at], line.high[at]


def test_no_interval_is_without_width_and_each_holds_its_number(table: RetentionTable) -> None:
    all_limits = [*intervals(table.all_rows), *intervals(table.differences), *of_probes(table)]
    assert len(all_limits) > 40
    names = {name.split(" ", 1)[1] for name, *_ in all_limits}
    assert names >= {"success.ci", "backbone.ci", "action.ci", "rules.sr_answered_ci"}
    assert names >= {".sr_ci", ".backbone_ci", ".action_ci"}
    for name, value, low, high in all_limits:
        assert high - low > 1e-3, name
        assert low <= value <= high, name


def test_shares_stay_shares_and_differences_of_shares_differences(table: RetentionTable) -> None:
    for name, _, low, high in [*intervals(table.all_rows), *of_probes(table)]:
        if "retention" not in name and "minus" not in name:
            assert 0 <= low < high <= 1, name
    for name, _, low, high in intervals(table.differences):
        if "retention" not in name and "models" not in name:
            assert -1 <= low < high <= 1, name


def test_equal_runs_differ_by_nothing_and_not_surely_so(table: RetentionTable) -> None:
    """Two models that agree in all 100 groups may differ in 3.6 % of others, and no more is allowed for."""
    rows = [row for row in table.differences if (row.group, row.minus) == ("again", "one")]
    assert rows
    for row in rows:
        for name in ("sr", "backbone", "action"):
            low, high = getattr(row, f"{name}_ci")
            assert getattr(row, name) == 0
            categories = max(1, len(row.categories))
            assert 0.001 < high < 0.08 / sqrt(categories) + 0.01, name
            assert 0.001 < -low < 0.08 / sqrt(categories) + 0.01, name


# -- one number has one interval -----------------------------------------------------------------------------


def test_one_number_has_one_interval_in_rows_curves_and_scores(table: RetentionTable) -> None:
    for row in table.rows:
        curve = table.results[row.run.location, row.target].curves[row.category, "mean"]
        streams = curve_scores(curve, seed_text=row.run.suite)
        assert streams is not None
        for name, part in (("backbone", row.backbone), ("action", row.action)):
            assert part.score == streams.accuracy(name)
            assert part.ci == limits(streams.interval(name))
        again = measure_retention(curve, seed_text=row.run.suite)
        assert again is not None
        value = None if isnan(again.value) else again.value
        assert (row.retention.value, row.retention.ci) == (value, limits(again.interval))


def test_the_interval_of_a_site_is_wilsons_in_scores_and_figures(table: RetentionTable) -> None:
    for results in table.results.values():
        for (category, view), curve in results.curves.items():
            view_scores = results.scores[
                (results.scores["category"] == category) & (results.scores["view"] == view)
            ]
            display = LayerCurveDisplay.from_results(results, category)
            drawn = {
                (stream.stream, int(layer), line.iteration): (line.low[at], line.high[at])
                for stream in display.streams
                for line in stream.lines
                for at, layer in enumerate(line.layers)
            }
            for row, (_, score) in enumerate(view_scores.iterrows()):
                expected = wilson(curve.correct[row].reshape(-1, 2).sum(axis=1))
                assert (score["ci_low"], score["ci_high"]) == pytest.approx(expected)
                site = curve.sites[row]
                assert drawn[site.stream, site.layer, site.iteration] == pytest.approx(expected)


def wilson(right: np.ndarray[Any, np.dtype[np.int64]]) -> tuple[float, float]:
    """Wilson's interval of (G,) hits in groups of two, with as many episodes as count."""
    groups, episodes = right.size, 2 * right.size
    share = right.sum() / episodes
    variance = np.sum((right - 2 * share) ** 2) * groups / (groups - 1) / episodes**2
    if variance == 0:
        count, quantile = float(groups), stats.norm.ppf(0.975)
    else:
        count = max(min(share * (1 - share) / variance, episodes), groups)
        quantile = stats.t.ppf(0.975, groups - 1)
    # The limits are the roots of (share − x)² = quantile² · x (1 − x) / count.
    cut = quantile**2 / count
    low, high = sorted(np.roots([1 + cut, -(2 * share + cut), share**2]).real)
    least = stats.binomtest(groups, groups).proportion_ci(method="wilson").low
    return max(0.0, min(low, least)), min(1.0, max(high, 1 - least))


# -- means ---------------------------------------------------------------------------------------------------


def test_a_mean_is_as_wide_as_its_only_category_and_else_as_its_parts_together(table: RetentionTable) -> None:
    """Independent categories: squares of the arms add up, of success rates and of accuracies."""
    for mean in table.means:
        run_rows = [row for row in table.rows if row.run.location == mean.run.location]
        if len(run_rows) == 1:
            for name in ("success", "backbone", "action", "retention"):
                assert getattr(mean, name).ci == pytest.approx(getattr(run_rows[0], name).ci), name
            continue
        for part, field in (("success", "sr"), ("backbone", "score"), ("action", "score")):
            arms = [(getattr(getattr(row, part), field), *getattr(row, part).ci) for row in run_rows]
            below = sqrt(sum((value - low) ** 2 for value, low, _ in arms)) / len(arms)
            above = sqrt(sum((high - value) ** 2 for value, _, high in arms)) / len(arms)
            middle = sum(value for value, *_ in arms) / len(arms)
            assert getattr(mean, part).ci == pytest.approx((middle - below, middle + above))


def scores_of(table: RetentionTable, row: RetentionRow) -> Scores:
    scores = curve_scores(
        table.results[row.run.location, row.target].curves[row.category, "mean"], seed_text=row.run.suite
    )
    assert scores is not None
    return scores.scores


def test_limits_of_mean_retention_are_fiellers_for_the_mean_scores(table: RetentionTable) -> None:
    """All ratios whose numerator minus ratio times denominator is not shown to differ from 0."""
    for mean in table.means:
        run_rows = [row for row in table.rows if row.run.location == mean.run.location]
        scores = [scores_of(table, row) for row in run_rows]
        parts = [float(np.diag(part_scores.covariance).sum()) for part_scores in scores]
        df = sum(parts) ** 2 / sum(
            part**2 / part_scores.df for part, part_scores in zip(parts, scores, strict=True)
        )
        V, t = sum(part_scores.covariance for part_scores in scores) / len(run_rows) ** 2, stats.t.ppf(0.975, df)
        top, bottom = np.mean([part_scores.above for part_scores in scores], axis=0)
        low, high = mean.retention.ci or (None, None)
        if bottom - t * sqrt(V[1, 1]) < bottom / 4 or bottom <= 0:
            assert (low, high) == (None, None)
            continue
        assert mean.retention.value == pytest.approx(top / bottom)
        for ratio in (low, high):
            assert ratio is not None
            variance = V[0, 0] - 2 * ratio * V[0, 1] + ratio**2 * V[1, 1]
            assert abs(top - ratio * bottom) == pytest.approx(1.1 * t * sqrt(variance))


def test_a_mean_of_equal_categories_without_variance_has_a_width(probed_run: ProbedRun) -> None:
    table = retention_table([probed_run({"color": PERFECT, "shape": PERFECT})])
    (mean,) = table.means
    low, high = mean.backbone.ci  # type: ignore[misc]
    assert (mean.backbone.score, high) == (1.0, 1.0)
    assert table.rows[0].backbone.ci[0] < low < 0.995, "two categories are known better than one"  # type: ignore[index,operator]


# -- groups that agree ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("value", "count"), [*product([0.0, 0.25, 0.5, 1.0], [1, 2, 12, 150])])
def test_groups_that_agree_have_an_interval_that_narrows_with_their_number(value: float, count: int) -> None:
    """As many tosses as groups, however many episodes these have."""
    names = np.repeat([f"g{at:03}" for at in range(count + 1)], 4)
    interval, more = (Share.of(np.full(4 * n, value), names[: 4 * n]).interval() for n in (count, count + 1))
    assert 0.0 <= interval.low <= value <= interval.high <= 1.0
    assert 0 < more.high - more.low < interval.high - interval.low + 1e-12
    if count == 1:
        assert (interval.low, interval.high) == (0, 1)
    elif value in (0, 1):
        exact = stats.binomtest(int(value * count), count).proportion_ci(0.95, "exact")
        assert (interval.low, interval.high) == pytest.approx((exact.low, exact.high))
        assert interval.high - interval.low < 4 / count


def test_an_untrained_network_that_is_beaten_alike_in_every_group_has_an_interval(probed_run: ProbedRun) -> None:
    results = load_results(probed_run({"color": PERFECT}, "one"))
    untrained = load_results(probed_run({"color": HOPELESS}, "untrained", random_weights=True))
    scores = add_untrained(results, untrained).controls.untrained
    assert scores
    for score in scores:
        assert -1 <= score.ci[0] <= score.difference <= score.ci[1] <= 1
        assert score.ci[1] - score.ci[0] > 1e-3


def test_a_band_of_few_permuted_labels_is_not_drawn(probed_run: ProbedRun) -> None:
    results = load_results(probed_run({"color": GOOD}))
    assert LayerCurveDisplay.from_results(results, "color").grounds[0].null_band is not None
    for count, is_drawn in ((5, False), (19, False), (20, True)):
        few = {
            curve_key: replace(curve, null=curve.null[:, :count]) for curve_key, curve in results.curves.items()
        }
        band = LayerCurveDisplay.from_results(replace(results, curves=few), "color").grounds[0].null_band
        assert (band is not None) == is_drawn
        layer_curve(replace(results, curves=few))


def test_the_band_holds_the_middle_95_percent_of_the_accuracies_of_permuted_labels(probed_run: ProbedRun) -> None:
    """Of 200 whole numbers from 1 to 200 %, five lie below the band and five above it."""
    results = load_results(probed_run({"color": GOOD}))
    accuracies = np.random.default_rng(0).permutation(np.arange(1, 201) / 100)
    curves = {
        curve_key: replace(curve, null=np.resize(accuracies, (len(curve.sites), 200)))
        for curve_key, curve in results.curves.items()
    }
    display = LayerCurveDisplay.from_results(replace(results, curves=curves), "color")
    assert display.grounds[0].null_band is not None
    low, high = (float(end[0]) for end in display.grounds[0].null_band)
    assert ((accuracies < low).sum(), (accuracies > high).sum()) == (5, 5)
    axes = display.plot().ax_
    assert axes is not None
    [(left, bottom), *_, (right, top)] = [axes.patches[0].get_bbox().min, axes.patches[0].get_bbox().max]
    assert (bottom, top) == pytest.approx((100 * low, 100 * high))
    assert left < right


# -- ratios --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("backbone", "expert"), [(1.0, 1.0), (0.95, 0.75), (0.8, 0.6)])
@pytest.mark.parametrize("items", [4, 5, 6, 8, 30])
def test_no_retention_has_a_limit_that_only_a_hardly_known_backbone_sets(
    curve_of: Callable[..., ProbeCurve], outcome_table: Callable[..., pd.DataFrame], items: int, backbone: float,
    expert: float,
) -> None:  # fmt: skip
    measurement = measure_retention(
        curve_of(outcome_table(2 * items, 0, 0), [0.5, backbone, backbone], [[expert, expert]])
    )
    assert measurement is not None
    if items == 4:
        assert measurement.streams is None
        assert not measurement.interval.bounded
        return
    assert measurement.streams is not None
    scores = measurement.streams.scores
    quantile = stats.t.ppf(0.975, items - 1)
    (top, bottom), V = scores.above, scores.covariance
    is_known = bottom - quantile * sqrt(V[1, 1]) >= bottom / 4 > 0
    assert measurement.interval.bounded == is_known
    if is_known:  # four times what the expert alone would allow at the most
        assert measurement.interval.high <= 4 * (top + quantile * sqrt(V[0, 0])) / bottom
    pooled = PooledScores.of([measurement.streams])
    assert pooled is not None
    difference = retention_difference(scores, scores, pooled.covariance_with(pooled)).interval
    assert difference.bounded == is_known


def test_five_groups_of_a_weak_signal_are_too_few_for_a_ratio_and_so_is_every_difference_with_them(
    curve_of: Callable[..., ProbeCurve], outcome_table: Callable[..., pd.DataFrame]
) -> None:
    """Not the mean with a category of many groups: its backbone is known well enough to divide by."""
    few, many = (
        curve_scores(curve_of(outcome_table(2 * items, 0, 0), [share], [[share]]), seed_text="suite")
        for items, share in ((5, 0.7), (60, 1.0))
    )
    assert few is not None
    assert many is not None
    few_retention, many_retention = retention(few.scores), retention(many.scores)
    assert (few_retention.value, many_retention.value) == pytest.approx((1, 1))
    assert (few_retention.interval.bounded, many_retention.interval.bounded) == (False, True)
    for first, other in ((few, many), (many, few)):
        assert not retention_difference(first.scores, other.scores).interval.bounded
    mean = retention(Scores.mean([few.scores, many.scores]))
    assert mean.interval.bounded
    assert np.diff([mean.interval.low, mean.interval.high]) > np.diff(
        [many_retention.interval.low, many_retention.interval.high]
    )


@pytest.mark.parametrize("right", [3.0, 0.0])
@pytest.mark.parametrize("groups", [10, 16])
def test_a_score_is_no_better_known_for_one_group_that_is_unlike_the_others(right: float, groups: int) -> None:
    sizes = np.full(groups, 4.0)
    alike = GroupSums(np.full((3, groups), 4.0), sizes)
    sums = alike.sums.copy()
    sums[:, 0] = right
    streams = [[stream_of(group_sums, range(3))] * 2 for group_sums in (GroupSums(sums, sizes), alike)]
    fit, same = (crossfit(pair, list(map(str, range(groups)))) for pair in streams)
    for stream in range(2):
        assert accuracy_interval(fit, stream).low < accuracy_interval(same, stream).low


def test_two_runs_that_differ_in_one_group_are_not_surer_alike_than_two_that_never_do(
    outcome_table: Callable[..., pd.DataFrame],
) -> None:
    right = outcome_table(32, 0, 0)
    wrong = right.copy()
    wrong.loc[wrong["item_id"] == wrong["item_id"].iloc[0], "outcome"] = "wrong"
    first, second = (Rate.pooled([success_share(outcomes, "suite")]) for outcomes in (right, wrong))
    same, other = first.minus(first).interval, first.minus(second).interval
    assert same.low < 0 < same.high
    assert other.low >= same.low
    assert other.high >= same.high
    assert second.interval.low < first.interval.low, "a group that is wrong makes nothing surer"
    several = Rate.pooled([success_share(outcomes, "suite") for outcomes in (right, wrong)])
    assert second.interval.low < several.interval.low < several.value < several.interval.high
