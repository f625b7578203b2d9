"""Every interval that a table, a report or a figure shows, searched in many worlds."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import product

import numpy as np
import pandas as pd
import pytest
from probe_kit.retention.estimators.bootstrap_draws import average, probe_estimates, sr_estimate
from probe_kit.retention.estimators.combined import area_fit, bounded_fit
from probe_kit.retention.estimators.cross_fit import GroupScores, crossfit
from scipy.special import stdtrit

from probe_kit.hooks.contract.sites import Site
from probe_kit.retention import (
    Difference,
    RetentionRow,
    RetentionTable,
    layer_curve,
    measure_retention,
    retention_table,
)
from probe_kit.retention.displays import LayerCurveDisplay
from probe_kit.statistics.bootstrap import group_bootstrap
from probe_kit.train import ArrayRun, ProbeCurve, load_results
from probe_kit.train.controls.fit_controls import add_untrained

ProbedRun = Callable[..., ArrayRun]
PERFECT = ([1.0, 1.0], [[1.0, 1.0]])
HOPELESS = ([0.0, 0.5], [[0.0, 0.5]])
GOOD = ([0.5, 0.9], [[0.6, 0.7]])
NONE = ([0.5, 0.52], [[0.5, 0.51]])
WORLDS = {
    "perfect": {"color": PERFECT},
    "perfect and good": {"color": PERFECT, "shape": GOOD},
    "perfect everywhere": {"color": PERFECT, "shape": PERFECT, "state": PERFECT},
    "hopeless": {"color": HOPELESS, "shape": NONE},
    "good": {"color": GOOD},
    "mixed": {"color": GOOD, "shape": NONE, "state": PERFECT},
}


@pytest.fixture(params=WORLDS)
def table(request: pytest.FixtureRequest, probed_run: ProbedRun) -> RetentionTable:
    """A run of the world against an equal one and against a good one."""
    world = WORLDS[request.param]
    runs = {name: [probed_run(world, name)] for name in ("one", "again")}
    return retention_table({**runs, "other": [probed_run(dict.fromkeys(world, GOOD), "other")]})


def intervals(rows: Sequence[RetentionRow] | Sequence[Difference]) -> Iterator[tuple[str, float, float, float]]:
    """Name, value and limits of every interval that has any; unbounded ones are an answer of their own."""
    values = {
        "backbone_ci": "backbone_accuracy", "action_ci": "action_accuracy",
        "success": "sr", "backbone": "accuracy", "action": "accuracy", "retention": "debiased",
    }  # fmt: skip
    for row in rows:
        fields = asdict(row)
        parts = [("", fields), *((name, part) for name, part in fields.items() if isinstance(part, dict))]
        for part, inner in parts:
            for name, limits in inner.items():
                if not (name == "ci" or name.endswith("_ci")) or limits is None or limits == (None, None):
                    continue
                of = values[part] if name == "ci" else values.get(name, name.removesuffix("_ci"))
                yield f"{row.category} {part}.{name}", inner[of], *limits


def test_no_interval_is_without_width_and_each_holds_its_number(table: RetentionTable) -> None:
    found = [*intervals(table.all_rows), *intervals(table.differences)]
    assert len(found) > 20
    for name, value, low, high in found:
        assert high - low > 1e-3, name
        assert low <= value <= high, name


def test_one_number_has_one_interval_in_rows_scores_and_curves(table: RetentionTable) -> None:
    for row in table.rows:
        results = table.results[row.run.location]
        scores = results.scores[results.scores["category"] == row.category]
        display = LayerCurveDisplay.from_results(results, row.category)
        for stream, layer, step, limits in (
            ("backbone", row.backbone.layer, None, row.backbone.ci),
            ("expert", row.action.layer, row.action.iteration, row.action.ci),
        ):
            site = scores[(scores["stream"] == stream) & (scores["layer"] == layer)]
            site = site if step is None else site[site["iteration"] == step]
            assert limits == (site["ci_low"].item(), site["ci_high"].item())
            (curve,) = [one for one in display.streams if one.stream == stream]
            at = list(curve.layers).index(layer)
            assert limits == (curve.low[at], curve.high[at])


def test_a_mean_is_as_wide_as_its_only_category_and_never_wider_known_than_its_parts(
    table: RetentionTable,
) -> None:
    for mean in table.means:
        own = [row for row in table.rows if row.run.location == mean.run.location]
        for name in ("success", "backbone", "action", "retention"):
            parts = [getattr(row, name).ci for row in own if name != "retention" or row.retention.defined]
            limits = getattr(mean, name).ci
            if len(parts) == 1:
                assert limits == parts[0], name
            elif parts and (None, None) in parts:
                assert limits == (None, None), name
            elif parts:
                widest = max(high - low for low, high in parts)
                assert limits[1] - limits[0] > 0.8 * widest / len(parts), name


def test_a_mean_of_equal_categories_without_variance_has_a_width(probed_run: ProbedRun) -> None:
    table = retention_table([probed_run({"color": PERFECT, "shape": PERFECT})])
    (mean,) = table.means
    low, high = mean.backbone.ci  # type: ignore[misc]
    assert (mean.backbone.accuracy, high) == (1.0, 1.0)
    assert table.rows[0].backbone.ci[0] < low < 0.99, "two categories are known better than one"  # type: ignore[index]


@pytest.mark.parametrize(("value", "count"), [*product([0.0, 0.25, 0.5, 1.0], [1, 2, 12, 150])])
def test_groups_that_agree_have_an_interval_that_narrows_with_their_number(value: float, count: int) -> None:
    column = np.full((4 * count, 1), value)
    low, high = group_bootstrap(column, np.arange(4 * count) // 4, seed=0)
    fewer_low, fewer_high = group_bootstrap(column[: 2 * count + 2], np.arange(2 * count + 2) // 4, seed=0)
    assert 0.0 <= low[0] <= value <= high[0] <= 1.0
    assert 0 < high[0] - low[0] <= fewer_high[0] - fewer_low[0] + 1e-9
    assert high[0] - low[0] < 4 / count


def test_a_twin_that_is_beaten_alike_in_every_group_has_an_interval(probed_run: ProbedRun) -> None:
    results = load_results(probed_run({"color": PERFECT}, "one"))
    twin = load_results(probed_run({"color": HOPELESS}, "twin", random_weights=True))
    for score in add_untrained(results, twin).controls.untrained:
        assert -1 <= score.ci[0] <= score.difference <= score.ci[1] <= 1
        assert score.ci[1] - score.ci[0] > 1e-3


def test_a_band_of_few_relabellings_is_not_drawn(probed_run: ProbedRun) -> None:
    results = load_results(probed_run({"color": GOOD}))
    assert LayerCurveDisplay.from_results(results, "color").null_band is not None
    few = {place: replace(curve, null=curve.null[:, :5]) for place, curve in results.curves.items()}
    assert LayerCurveDisplay.from_results(replace(results, curves=few), "color").null_band is None
    layer_curve(replace(results, curves=few))


@pytest.mark.parametrize(("backbone", "expert"), [(1.0, 1.0), (0.95, 0.75), (0.8, 0.6)])
@pytest.mark.parametrize("items", [3, 6, 8, 30])
def test_no_retention_has_a_limit_that_only_a_hardly_known_backbone_sets(
    curve_of: Callable[..., ProbeCurve], outcome_table: Callable[..., pd.DataFrame], items: int, backbone: float,
    expert: float,
) -> None:  # fmt: skip
    curve = curve_of(outcome_table(2 * items, 0, 0), [0.5, backbone, backbone], [[expert, expert]])
    found = measure_retention(curve)
    assert found is not None
    drawn = probe_estimates(curve, {}, found, "suite")
    for kind, interval, fit in (
        ("debiased", found.interval, found.fit),
        ("bounded", found.bounded_interval, found.bounded_fit),
        ("area", found.area_interval, found.area_fit),
    ):
        quantile = stdtrit(min(items - 1, 100), 0.975)
        known = fit.backbone - quantile * fit.covariance[1, 1] ** 0.5 >= fit.backbone / 4 > 0
        assert interval.bounded == known, kind
        assert (drawn[f"retention_{kind}"].ci == (None, None)) >= (not known), kind
        if known:  # four times what the expert alone would allow at the most
            most = fit.expert + quantile * fit.covariance[0, 0] ** 0.5
            assert interval.high <= 4 * most / fit.backbone, kind
        halved = replace(drawn[f"retention_{kind}"], value=0.5)
        assert ((halved - drawn[f"retention_{kind}"]).ci == (None, None)) >= (not known), kind


def test_six_groups_that_all_agree_are_too_few_for_a_ratio_and_so_is_every_mean_and_difference_with_them(
    curve_of: Callable[..., ProbeCurve], outcome_table: Callable[..., pd.DataFrame]
) -> None:
    few, many = (curve_of(outcome_table(2 * items, 0, 0), [1.0], [[1.0]]) for items in (6, 60))
    scores = [measure_retention(one) for one in (few, many)]
    estimates = [probe_estimates(one, {}, score, "suite") for one, score in zip((few, many), scores, strict=True)]
    assert [score.bounded_interval.bounded for score in scores if score] == [False, True]
    for name in (f"retention_{kind}" for kind in ("debiased", "bounded", "area")):
        here, there = (found[name] for found in estimates)
        assert here.value == there.value == 1
        assert there.ci != (None, None)
        for unclear in (here, here - there, there - here, average([here, there]), average([here, there]).centred):
            assert unclear.ci == (None, None), name


@pytest.mark.parametrize("right", [3.0, 0.0])
@pytest.mark.parametrize("groups", [10, 16])
def test_a_ratio_is_no_better_known_for_one_group_that_is_unlike_the_others(right: float, groups: int) -> None:
    sizes = np.full(groups, 4.0)
    alike = GroupScores(np.full((3, groups), 4.0), sizes)
    sums = alike.sums.copy()
    sums[:, 0] = right
    one = GroupScores(sums, sizes)
    places = [Site("backbone", layer) for layer in range(3)]
    for fit in (
        lambda scores: crossfit(scores, scores, 0.5, 0),
        lambda scores: bounded_fit(scores, scores, (places, places), 0.5, 0),
        lambda scores: area_fit(scores, scores, 0.5),
    ):
        for stream in range(2):
            least = [
                (found.expert, found.backbone)[stream] - 1.96 * found.covariance[stream, stream] ** 0.5
                for found in (fit(one), fit(alike))
            ]
            assert least[0] < least[1]


def test_two_runs_that_differ_in_one_group_are_not_surer_alike_than_two_that_never_do(
    outcome_table: Callable[..., pd.DataFrame],
) -> None:
    right = outcome_table(32, 0, 0)
    wrong = right.copy()
    wrong.loc[wrong["item_id"] == wrong["item_id"].iloc[0], "outcome"] = "wrong"
    here, there = (sr_estimate(one, "suite") for one in (right, wrong))
    same, other = (here - here).ci, (here - there).ci
    assert same[0] is not None
    assert same[1] is not None
    assert other[0] >= same[0]  # type: ignore[operator]
    assert other[1] >= same[1]  # type: ignore[operator]
    several = average([here, there])
    assert there.ci[0] <= several.ci[0] <= here.ci[0]  # type: ignore[operator]
