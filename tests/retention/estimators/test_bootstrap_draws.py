from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest

from probe_kit.retention import best_site, measure_retention
from probe_kit.retention.estimators.bootstrap_draws import (
    Estimate,
    average,
    probe_estimates,
    retention_draws,
    sr_estimate,
)
from probe_kit.retention.estimators.cross_fit import Crossfit
from probe_kit.statistics.bootstrap import group_bootstrap
from probe_kit.train import ProbeCurve

CurveOf = Callable[..., ProbeCurve]
Outcomes = Callable[..., pd.DataFrame]


def estimates_of(curve: ProbeCurve, suite: str = "s@1#0") -> dict[str, Estimate]:
    peaks = {"backbone": best_site(curve, "backbone"), "action": best_site(curve, "expert")}
    found = {name: peak for name, peak in peaks.items() if peak is not None}
    return probe_estimates(curve, found, measure_retention(curve), suite)


def test_intervals_are_those_of_the_bootstrap_over_groups(curve_of: CurveOf, outcome_table: Outcomes) -> None:
    curve = curve_of(outcome_table(100, 100, 0), [0.5, 0.9], [[0.6, 0.7]])
    found = estimates_of(curve)["backbone_accuracy"]
    low, high = group_bootstrap(curve.correct[[1]].T, curve.groups, found.units)
    assert found.value == 0.9
    assert found.ci == (low[0], high[0])


def test_draws_of_retention_spread_like_its_fieller_interval(curve_of: CurveOf, outcome_table: Outcomes) -> None:
    curve = curve_of(outcome_table(200, 200, 0), [0.5, 0.9, 0.7], [[0.6, 0.7]])
    exact = measure_retention(curve)
    assert exact is not None
    low, high = estimates_of(curve)["retention_debiased"].ci
    assert low == pytest.approx(exact.interval.low, abs=0.04)
    assert high == pytest.approx(exact.interval.high, abs=0.04)


def fit_of(expert: float, backbone: float, choosing: float = 0.0) -> Crossfit:
    """Groups of two episodes that all have these accuracies; the variance that choosing adds to both."""
    held_out = np.tile([[2 * expert], [2 * backbone]], 100)
    return Crossfit(expert - 0.5, backbone - 0.5, choosing * np.eye(2), held_out, np.full(100, 2.0))


def test_choosing_adds_its_own_spread_to_every_draw() -> None:
    np.testing.assert_allclose(retention_draws(fit_of(0.7, 0.9), 0.5, units=0), 0.5)
    draws = retention_draws(fit_of(0.7, 0.9, choosing=1e-4), 0.5, units=0)
    assert draws.std() == pytest.approx(np.hypot(0.01, 0.5 * 0.01) / 0.4, rel=0.1)


def test_runs_on_the_same_groups_do_not_share_the_luck_of_choosing() -> None:
    one, other = (retention_draws(fit_of(share, 0.9, choosing=1e-4), 0.5, units=0) for share in (0.7, 0.71))
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.1


def test_a_backbone_at_chance_gives_no_ratio() -> None:
    assert np.isnan(retention_draws(fit_of(0.6, 0.4), 0.5, units=0)).all()


def test_retention_without_backbone_signal_is_not_estimated(curve_of: CurveOf, outcome_table: Outcomes) -> None:
    assert set(estimates_of(curve_of(outcome_table(100, 100, 0), [0.55], [[0.6]]))) == {
        "backbone_accuracy",
        "action_accuracy",
    }


def test_the_same_items_are_drawn_together_and_others_apart(outcome_table: Outcomes) -> None:
    episodes = outcome_table(100, 60, 40)
    here, again, elsewhere = (sr_estimate(episodes, suite) for suite in ("s@1#0", "s@1#0", "t@1#1"))
    fewer = sr_estimate(episodes[:150], "s@1#0")
    assert here.units == again.units
    assert len({here.units, elsewhere.units, fewer.units}) == 3
    widths = []
    for other in (again, elsewhere):
        low, high = (here - other).ci
        assert low is not None
        assert high is not None
        assert low < 0 < high
        widths.append(high - low)
    assert widths[0] < widths[1] / 2, "what is paired is known better, and not for certain"


def test_an_average_of_independent_estimates_is_narrower_by_the_root_of_their_number() -> None:
    generator = np.random.default_rng(0)
    many = [Estimate(0.5, generator.normal(0.5, 0.1, 4000), units) for units in range(9)]
    assert average(many).draws.std() == pytest.approx(0.1 / 3, rel=0.1)
    assert average(many[:1]).units == many[0].units


def test_too_many_draws_without_meaning_leave_no_limits() -> None:
    draws = np.linspace(0, 1, 1000)
    draws[:20] = np.nan
    assert Estimate(0.5, draws, 0).ci[0] is not None
    draws[:30] = np.nan
    assert Estimate(0.5, draws, 0).ci == (None, None)


@pytest.mark.slow
def test_the_interval_of_a_difference_covers_the_truth() -> None:
    """Two policies that share half of what makes an item easy."""
    covered = []
    for seed in range(400):
        generator = np.random.default_rng(seed)
        ease = generator.standard_normal(100).repeat(2)
        tables = [
            pd.DataFrame(
                {
                    "item_id": np.arange(100).repeat(2).astype(str),
                    "outcome": np.where(ease + generator.standard_normal(200) < 0, "correct", "wrong"),
                }
            )
            for _ in range(2)
        ]
        gap = sr_estimate(tables[0], f"s{seed}") - sr_estimate(tables[1], f"s{seed}")
        low, high = gap.ci
        covered.append(low is not None and high is not None and low <= 0 <= high)
    assert 0.92 <= np.mean(covered) <= 0.98


def test_the_interval_of_a_mean_of_skewed_ratios_lies_around_their_mean() -> None:
    """The average of ratios drifts: without centring four in five draws lie above the estimate."""
    generator = np.random.default_rng(0)
    parts = [
        Estimate(1.0, 1 / (1 + 0.3 * generator.standard_normal(2000)).clip(min=0.2), units, 150)
        for units in range(12)
    ]
    mean = average(parts)
    assert np.mean(mean.draws > mean.value) > 0.75
    low, high = mean.centred.ci
    assert low is not None
    assert high is not None
    assert np.mean(mean.centred.draws > mean.value) == pytest.approx(0.5, abs=0.01)
    assert low < 1 - 0.1
    assert high > 1 + 0.1


def test_centring_keeps_draws_without_meaning() -> None:
    draws = np.array([np.nan] * 100 + [1.0] * 900)
    assert Estimate(2.0, draws, 0).centred.ci == (None, None)
    assert np.isnan(Estimate(2.0, draws, 0).centred.draws).sum() == 100


@pytest.mark.parametrize("right", [0.99, 0.95, 0.8])
def test_a_mean_of_categories_that_are_nearly_perfect_covers_the_truth(right: float) -> None:
    """What nobody has seen of twelve of them lies on one side of each, and not beside their mean."""
    generator, groups, covered = np.random.default_rng(0), np.arange(24) // 2, []
    for world in range(60):
        parts = []
        for category in range(12):
            hits = generator.random(12) < right
            outcome = np.where(hits[groups], "correct", "wrong")
            table = pd.DataFrame({"item_id": groups.astype(str), "outcome": outcome})
            parts.append(sr_estimate(table, f"{world} {category}"))
        mean = average(parts)
        low, high = mean.ci
        assert low is not None
        assert high is not None
        assert 0 <= low <= mean.value <= high <= 1
        covered.append(low <= right <= high)
    assert np.mean(covered) >= 0.9
