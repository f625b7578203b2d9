"""Intervals of means, shares, differences and ratios."""

from collections.abc import Callable
from itertools import product
from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats
from scipy.stats import binomtest

from probe_kit.errors import UsageError
from probe_kit.statistics.bootstrap import (
    GAINS,
    SHARES,
    Bounds,
    bootstrap_means,
    draw_groups,
    explained_interval,
    group_bootstrap,
    reach,
    student_interval,
    unlike,
    unseen_quantiles,
    widen_draws,
)
from probe_kit.statistics.folds import OUTER_FOLDS, SHARED_TRAINING
from probe_kit.statistics.intervals import (
    NO_LIMITS,
    Accuracy,
    Interval,
    Share,
    difference_interval,
    fieller_interval,
    mean_interval,
)
from probe_kit.statistics.paired_tests import clopper_pearson
from probe_kit.statistics.share_limits import (
    effective_groups,
    exchangeable_variances,
    group_shares,
    korn_graubard_limits,
    wilson_limits,
    wilson_low,
)

Values = NDArray[np.float64]
Limited = Callable[[Values, Values, float], tuple[Values, Values]]
COUNTS = (2, 5, 16)
QUARTERS = np.linspace(0, 1, 5)


def limits(each: Values, bounds: Bounds = SHARES) -> tuple[float, float]:
    """Of (G,) means of groups of one episode each."""
    low, high = group_bootstrap(each[:, None], np.arange(each.size), 0, bounds=bounds)
    return float(low[0]), float(high[0])


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("bounds", [SHARES, GAINS])
def test_one_group_unlike_the_others_draws_no_limit_in_on_its_side(count: int, bounds: Bounds) -> None:
    grid = bounds[0] + (bounds[1] - bounds[0]) * QUARTERS
    for like, other in product(grid, grid):
        alike = np.full(count, like)
        changed_group = alike.copy()
        changed_group[0] = other
        before, after = limits(alike, bounds), limits(changed_group, bounds)
        if other < like:
            assert after[0] <= before[0] + 1e-9, (like, other)
        else:
            assert after[1] >= before[1] - 1e-9, (like, other)


@pytest.mark.parametrize("count", COUNTS)
def test_every_further_miss_lowers_both_limits(count: int) -> None:
    both_limits = np.array([limits((np.arange(count) >= misses).astype(float)) for misses in range(count + 1)])
    assert (np.diff(both_limits, axis=0) <= 1e-9).all()
    exact = np.array([clopper_pearson(count - misses, count) for misses in range(count + 1)])
    np.testing.assert_allclose(both_limits[[0, -1]], exact[[0, -1]], atol=1e-3)


def test_sixteen_of_sixteen_is_better_known_than_fifteen() -> None:
    all_right, one_wrong = limits(np.ones(16)), limits(np.arange(16) > 0)
    assert all_right[0] == pytest.approx(clopper_pearson(16, 16)[0], abs=1e-3)
    assert one_wrong[0] == pytest.approx(15 / 16 * all_right[0], abs=1e-3)
    net_all, net_one = limits(np.ones(16), GAINS), limits((np.arange(16) > 0).astype(float), GAINS)
    assert net_one[1] - net_one[0] > net_all[1] - net_all[0]


def test_groups_that_differ_anyway_are_drawn_as_they_are() -> None:
    each = np.random.default_rng(0).binomial(4, 0.6, 75)[:, None] / 4
    draws = bootstrap_means(each, np.arange(75), 0)
    assert (reach(each) == 0).all()
    wide = widen_draws(draws, each.mean(axis=0), each, 0)
    np.testing.assert_array_equal(*(np.percentile(values, [1, 2.5, 50, 97.5, 99]) for values in (wide, draws)))


def test_draws_keep_their_order_and_equal_ones_have_one_order_for_all() -> None:
    each = (np.arange(12) > 0).astype(float)[:, None]
    draws = bootstrap_means(each, np.arange(12), 0)
    wide = widen_draws(draws, each.mean(axis=0), each, 0)
    order = np.argsort(wide[:, 0], kind="stable")
    assert (np.diff(draws[order, 0]) >= 0).all()
    again = widen_draws(draws + 1e-15 * draw_groups(12, 3)[:, :1], each.mean(axis=0), each, 0)
    np.testing.assert_allclose(again, wide, atol=1e-9)


def test_how_many_are_unlike_most() -> None:
    each = np.array([[1, 1, 0.1], [1, 0, 0.1 + 1e-16], [1, 0, 0.5], [1, 1, 0.7], [1, 0.5, 0.2]])
    assert unlike(each).tolist() == [0, 3, 3]


def test_limits_hold_the_unseen_value_and_are_centred_near_it() -> None:
    for bounds, value in product((SHARES, GAINS), (0.0, 0.4, 1.0)):
        each = np.full((10, 1), value)
        percentiles = unseen_quantiles(np.array([value]), each, bounds=bounds)[:, 0]
        assert bounds[0] <= percentiles[0] < percentiles[-1] <= bounds[1]
        assert (np.diff(percentiles) >= 0).all()
        assert percentiles[percentiles.size // 2 - 1] <= value <= percentiles[percentiles.size // 2]


WORLDS: dict[str, tuple[Bounds, dict[float, float]]] = {
    "right but for one in twenty": (SHARES, {1: 0.95, 0: 0.05}),
    "right but for one in seven": (SHARES, {1: 0.85, 0: 0.15}),
    "hardly ever half or wrong": (SHARES, {1: 0.9, 0.5: 0.05, 0: 0.05}),
    "often a little wrong, hardly ever all": (SHARES, {1: 0.85, 0.75: 0.1, 0: 0.05}),
    "no gain, or all": (GAINS, {0: 0.8, 1: 0.1, 0.25: 0.1}),
    "all gain, or the reverse": (GAINS, {1: 0.85, 0.5: 0.1, -1: 0.05}),
    "a little either way": (GAINS, {0: 0.8, 0.25: 0.1, -0.25: 0.1}),
}


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
def test_intervals_of_groups_that_are_mostly_alike_cover_the_truth(world: str) -> None:
    count = 12
    bounds, shares = WORLDS[world]
    values, chances = np.array(list(shares)), list(shares.values())
    generator = np.random.default_rng(0)
    each = generator.choice(values, (count, 500), p=chances)
    low, high = group_bootstrap(each, np.arange(count), 0, bounds=bounds)
    truth = float(values @ chances)
    covered = (low - 1e-9 <= truth) & (truth <= high + 1e-9)
    assert covered.mean() >= 0.94, "as many as drawn, less what 500 worlds are off by"


@pytest.mark.parametrize(("count", "draw"), [(3, "standard_normal"), (6, "random"), (12, "standard_normal")])
def test_a_measured_quantity_is_covered_with_few_groups(count: int, draw: str) -> None:
    generator = np.random.default_rng(0)
    sample: Callable[[int], Values] = getattr(generator, draw)
    truth = 0.5 if draw == "random" else 0.0
    groups = np.arange(2 * count) // 2
    covered = []
    for _ in range(400):
        low, high = student_interval(sample(count).repeat(2) / 100, groups, 0)
        covered.append(low <= truth / 100 <= high)
    assert np.mean(covered) >= 0.92


def test_a_measured_quantity_has_limits_where_nothing_varies() -> None:
    assert student_interval(np.array([0.2, 0.4]), ["a", "a"], 0) == GAINS
    low, high = student_interval(np.full(10, 0.2), np.arange(10), 0)
    assert -1 < low < 0.2 < high < 1
    assert student_interval(np.array([-1.0, 1.0, 1.0]), np.arange(3), 0) == GAINS


TEN_GROUPS = np.repeat(np.arange(12), 5)


def drawn(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Target, predictions and scores of 12 groups of five."""
    generator = np.random.default_rng(seed)
    labels = generator.standard_normal(60) + generator.standard_normal(12)[TEN_GROUPS]
    predicted = 0.7 * labels + 0.5 * generator.standard_normal(60)
    return labels, predicted, 1 - (labels - predicted) ** 2 / labels.var()


def test_the_interval_of_r2_is_that_of_a_ratio_of_sums_over_groups() -> None:
    labels, predicted, scores = drawn()
    errors, deviations = (labels - predicted) ** 2, (labels - labels.mean()) ** 2
    of_group = np.array([[errors[g == TEN_GROUPS].sum(), deviations[g == TEN_GROUPS].sum()] for g in range(12)])
    ratio = of_group[:, 0].sum() / of_group[:, 1].sum()
    # Cochran, Sampling Techniques, 6.13: the variance of a ratio estimator.
    residuals = of_group[:, 0] - ratio * of_group[:, 1]
    error = np.sqrt(residuals.var(ddof=1) / 12) / of_group[:, 1].mean()
    above, below = np.exp(stats.t(11, np.log(ratio), error / ratio).interval(0.95))
    assert explained_interval(scores, deviations, TEN_GROUPS) == pytest.approx((1 - below, 1 - above))


def test_it_is_nearly_the_jackknife_over_groups() -> None:
    labels, predicted, scores = drawn(1)
    errors, deviations = (labels - predicted) ** 2, (labels - labels.mean()) ** 2
    without = np.array([1 - errors[g != TEN_GROUPS].sum() / deviations[g != TEN_GROUPS].sum() for g in range(12)])
    error = np.sqrt(11 / 12 * ((without - without.mean()) ** 2).sum())
    low, high = explained_interval(scores, deviations, TEN_GROUPS)
    assert (high - low) / 2 == pytest.approx(stats.t.ppf(0.975, 11) * error, rel=0.15)


def test_folds_that_share_training_groups_widen_the_interval_by_one_half() -> None:
    labels, _, scores = drawn()
    deviations = (labels - labels.mean()) ** 2
    shared, alone = (explained_interval(scores, deviations, TEN_GROUPS, by)[0] for by in (SHARED_TRAINING, 1.0))
    assert pytest.approx(1.5) == SHARED_TRAINING
    assert OUTER_FOLDS == 5
    lengths = [np.log((1 - low) / (1 - scores.mean())) for low in (shared, alone)]
    assert lengths[0] == pytest.approx(1.5 * lengths[1])


def test_r2_does_not_depend_on_the_unit_of_the_label_and_ends_at_one() -> None:
    labels, _, scores = drawn()
    deviations = (labels - labels.mean()) ** 2
    assert explained_interval(scores, 9 * deviations, TEN_GROUPS) == pytest.approx(
        explained_interval(scores, deviations, TEN_GROUPS)
    )
    assert explained_interval(0.3 * scores + 0.7, deviations, TEN_GROUPS, 5.0)[1] < 1.0
    assert explained_interval(np.ones(60), deviations, TEN_GROUPS) == (1.0, 1.0)


def test_a_single_group_and_a_constant_label_are_no_error() -> None:
    _, _, scores = drawn()
    assert explained_interval(scores, np.ones(60), np.zeros(60)) == (-inf, 1.0)
    low, high = explained_interval(np.zeros(60), np.zeros(60), TEN_GROUPS)
    assert (low, high) == (0.0, 0.0)


def test_a_score_lies_within_its_interval_although_subtractions_round() -> None:
    scores = np.full(len(TEN_GROUPS), -5e-17)
    low, high = explained_interval(scores, np.ones(len(TEN_GROUPS)), TEN_GROUPS)
    assert low <= scores.mean() <= high


def test_limits_solve_fiellers_equation() -> None:
    covariance = np.array([[0.04, 0.01], [0.01, 0.02]])
    interval = fieller_interval(1.0, 2.0, covariance, 1.96)
    for ratio in (interval.low, interval.high):
        variance = covariance[0, 0] - 2 * ratio * covariance[0, 1] + ratio**2 * covariance[1, 1]
        assert (1.0 - ratio * 2.0) ** 2 == pytest.approx(1.96**2 * variance)
    assert interval.low < 0.5 < interval.high


def test_a_certain_denominator_gives_the_ordinary_interval() -> None:
    interval = fieller_interval(1.0, 2.0, np.diag([0.04, 0.0]), 1.96)
    assert (interval.low, interval.high) == pytest.approx((0.5 - 0.196, 0.5 + 0.196))


def test_a_denominator_that_may_be_zero_leaves_the_ratio_unbounded() -> None:
    interval = fieller_interval(1.0, 0.2, np.diag([0.04, 0.04]), 1.96)
    assert interval == Interval(-inf, inf)
    assert not interval.bounded
    assert str(interval) == "[no limits]"


def test_intervals_cover_the_true_ratio_nineteen_times_in_twenty() -> None:
    generator = np.random.default_rng(0)
    covariance = np.array([[0.03, 0.015], [0.015, 0.02]])
    draws = generator.multivariate_normal([0.6, 1.0], covariance, size=4000)
    intervals = [fieller_interval(numerator, denominator, covariance, 1.96) for numerator, denominator in draws]
    covered = np.mean([interval.low <= 0.6 <= interval.high for interval in intervals])
    assert 0.94 <= covered <= 0.96


def normal(value: float, error: float) -> Interval:
    return Interval(value - 1.96 * error, value + 1.96 * error)


@given(st.floats(-1, 1), st.floats(0.01, 1), st.floats(-1, 1), st.floats(0.01, 1), st.floats(-0.99, 0.99))
def test_symmetric_limits_give_the_normal_interval_of_a_difference(
    a: float, of_a: float, b: float, of_b: float, correlation: float
) -> None:
    interval = difference_interval(a, normal(a, of_a), b, normal(b, of_b), correlation)
    error = np.sqrt(of_a**2 + of_b**2 - 2 * correlation * of_a * of_b)
    assert (interval.low, interval.high) == pytest.approx((a - b - 1.96 * error, a - b + 1.96 * error))


def test_skewed_limits_keep_their_sides() -> None:
    """Distances 0.3 and 0.4 give 0.5 below; 0.5 and 1.2 give 1.3 above."""
    interval = difference_interval(1.0, Interval(0.7, 1.5), 2.0, Interval(0.8, 2.4))
    assert (interval.low, interval.high) == pytest.approx((-1.5, 0.3))


def test_the_same_estimate_twice_differs_by_exactly_nothing() -> None:
    interval = difference_interval(0.4, Interval(0.2, 0.6), 0.4, Interval(0.2, 0.6), 1.0)
    assert (interval.low, interval.high) == pytest.approx((0, 0))


def test_a_difference_of_which_one_side_has_no_limits_has_none() -> None:
    assert difference_interval(1, NO_LIMITS, 0, Interval(-1, 1)) == NO_LIMITS
    assert difference_interval(1, Interval(0, 2), 0, Interval(-inf, 1)) == NO_LIMITS
    assert mean_interval([1, 2], [Interval(0, 2), NO_LIMITS]) == NO_LIMITS


def test_a_mean_of_equal_parts_is_narrower_by_the_root_of_their_number() -> None:
    interval = mean_interval([0.5] * 16, [Interval(0.3, 0.6)] * 16)
    assert (interval.low, interval.high) == pytest.approx((0.45, 0.525))


def test_a_mean_of_shares_that_never_failed_stays_below_one() -> None:
    interval = mean_interval([1.0] * 12, [Interval(0.735, 1.0)] * 12)
    assert (interval.low, interval.high) == pytest.approx((1 - 0.265 / np.sqrt(12), 1.0))


def test_no_estimates_and_impossible_correlations_are_refused() -> None:
    with pytest.raises(UsageError, match="no estimates"):
        mean_interval([], [])
    with pytest.raises(UsageError, match=r"correlation of 1\.5"):
        difference_interval(0, Interval(-1, 1), 0, Interval(-1, 1), 1.5)


GROUPS = np.repeat(list("abcdefgh"), 4)


@pytest.mark.parametrize(("hits", "trials"), [(0, 10), (3, 10), (17, 20), (40, 40), (1, 200)])
def test_groups_of_one_episode_have_clopper_and_pearsons_interval_of_one_fewer(hits: int, trials: int) -> None:
    computed = korn_graubard_limits((np.arange(trials) < hits)[None].astype(float), np.ones(trials))
    if hits in (0, trials):
        exact = binomtest(hits, trials).proportion_ci(0.95, "exact")
        np.testing.assert_allclose(np.ravel(computed), (exact.low, exact.high), atol=1e-9)
        return
    right, count = hits / trials * (trials - 1), trials - 1  # s (1 − s) / v with v = s (1 − s) / (G − 1)
    low = min(stats.beta.ppf(0.025, right, count - right + 1), 0.025 ** (1 / trials))
    high = max(stats.beta.ppf(0.975, right + 1, count - right), 1 - 0.025 ** (1 / trials))
    np.testing.assert_allclose(np.ravel(computed), (low, high), atol=1e-9)


def test_twelve_of_twelve_groups_right_leave_a_quarter_open() -> None:
    low, high = korn_graubard_limits(np.full((1, 12), 4.0), np.full(12, 4.0))
    assert (float(low[0]), float(high[0])) == pytest.approx((0.025 ** (1 / 12), 1.0))
    assert float(low[0]) == pytest.approx(0.735, abs=5e-4)


@pytest.mark.parametrize("limits_of", [korn_graubard_limits, wilson_limits])
@pytest.mark.parametrize("sizes", [np.full(20, 4.0), 1.0 + np.arange(20) % 5], ids=["equal", "unequal"])
def test_limits_of_many_shares_are_those_of_each(limits_of: Limited, sizes: Values) -> None:
    sums = (
        np.random.default_rng(0).binomial(sizes.astype(int), np.array([[0.0], [0.3], [0.9], [1.0]])).astype(float)
    )
    together = limits_of(sums, sizes, 0.05)
    each = [limits_of(sums[[row]], sizes, 0.05) for row in range(len(sums))]
    np.testing.assert_allclose(together, np.array(each)[:, :, 0].T)


# An error more may make groups more alike, so that a variance falls.
PATTERNS = st.sampled_from(["spread", "drawn", "group by group", "the largest first"])


def errors_one_by_one(sizes: Values, pattern: str, seed: int) -> Values:
    """(E + 1, G) errors, from none to all of sum(sizes)."""
    generator, steps = np.random.default_rng(seed), [np.zeros(sizes.size)]
    while steps[-1].sum() < sizes.sum():
        last = steps[-1]
        room = np.flatnonzero(last < sizes)
        at = {
            "spread": room[np.argmin(last[room])],
            "drawn": generator.choice(room),
            "group by group": room[0],
            "the largest first": room[np.argmax(sizes[room])],
        }[pattern]
        steps.append(last + (np.arange(sizes.size) == at))
    return np.array(steps)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 8), min_size=2, max_size=24), st.booleans(), PATTERNS, st.integers(0, 99))
def test_limits_never_rise_with_an_added_error(counts: list[int], equal: bool, pattern: str, seed: int) -> None:
    """A share of unequal groups also has the variance of groups that are all equally alike, which may fall."""
    sizes = np.full(len(counts), float(counts[0])) if equal else np.array(counts, float)
    right = sizes - errors_one_by_one(sizes, pattern, seed)
    for limits_of in (wilson_limits, korn_graubard_limits) if equal else (wilson_limits,):
        assert np.diff(limits_of(right, sizes), axis=1).max() <= 1e-12
    low, high = wilson_limits(right, sizes)
    shares = right.sum(axis=1) / sizes.sum()
    assert (low <= shares + 1e-12).all()
    assert (shares <= high + 1e-12).all()


def test_an_error_beside_all_right_has_nearly_the_limit_of_all_right() -> None:
    """A mean of twelve sites that are all right is 1 − 1e-16."""
    sizes = np.full(12, 4.0)
    for missing in (0.0, 1e-15, 1e-12, 1e-6):
        assert wilson_limits(sizes[None] - missing, sizes)[0] == pytest.approx(0.7575, abs=5e-4)


def test_episodes_that_agree_within_groups_widen_the_interval() -> None:
    mixed = Share.of(np.tile([1, 0, 1, 0], 8), GROUPS)
    alike = Share.of(np.repeat([1, 0], 16), GROUPS)
    assert mixed.value == alike.value == 0.5
    assert alike.interval().low < mixed.interval().low < 0.5 < mixed.interval().high < alike.interval().high


def test_the_variance_is_that_of_a_ratio_estimator_over_groups() -> None:
    generator = np.random.default_rng(0)
    sizes = generator.integers(1, 9, 24)
    groups = np.repeat([f"{number:02d}" for number in range(24)], sizes)
    values = generator.random(groups.size) < 0.7
    share = Share.of(values, groups)
    sums = np.array([values[groups == name].sum() for name in np.unique(groups)], float)
    residuals = sums - values.mean() * sizes
    assert share.variance == pytest.approx((residuals**2).sum() * 24 / 23 / values.size**2)
    both, variances = group_shares(np.array([sums, sizes - sums]), sizes.astype(float))
    assert both.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(variances, share.variance)


def test_equally_alike_episodes_vary_as_their_correlation_says() -> None:
    """Kish: E² v = s (1 − s) Σ size (1 + (size − 1) ρ), with ρ of all pairs of a group."""
    sizes = np.array([2.0, 2, 4, 4, 6, 12])
    sums = np.array([[2.0, 0, 3, 1, 6, 5]])
    share = sums.sum() / sizes.sum()
    alike = 1 - (sums * (sizes - sums)).sum() / (sizes * (sizes - 1)).sum() / (share * (1 - share))
    expected = share * (1 - share) * (sizes * (1 + (sizes - 1) * alike)).sum() / sizes.sum() ** 2
    assert exchangeable_variances(sums, sizes) == pytest.approx(expected * 6 / 5)
    equal = np.full(6, 6.0)
    np.testing.assert_allclose(exchangeable_variances(sums / 2, equal), group_shares(sums / 2, equal)[1])


def test_unequal_groups_are_worth_fewer_equal_ones() -> None:
    assert effective_groups(np.full(7, 3.0)) == pytest.approx(7)
    assert effective_groups(np.array([9.0, 1.0])) == pytest.approx(100 / 82)
    assert Share.of([1, 1, 1, 0], list("aaab")).df == 1


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 1), st.integers(0, 9)), min_size=1, max_size=60))
def test_an_interval_holds_its_share_and_stays_between_zero_and_one(pairs: list[tuple[float, int]]) -> None:
    share = Share.of([value for value, _ in pairs], [str(group) for _, group in pairs])
    interval = share.interval()
    assert 0 <= interval.low <= share.value + 1e-9
    assert share.value - 1e-9 <= interval.high <= 1


def test_intervals_of_correlated_groups_cover_their_share() -> None:
    generator = np.random.default_rng(1)
    covered = []
    for _ in range(600):
        chance = generator.beta(1.4, 0.6, 12)  # mean 0.7, correlation 1/3
        interval = Share.of(generator.random(48) < np.repeat(chance, 4), np.repeat(np.arange(12), 4)).interval()
        covered.append(interval.low <= 0.7 <= interval.high)
    assert np.mean(covered) > 0.93


def test_shares_on_the_same_groups_are_correlated_and_on_others_are_not() -> None:
    generator = np.random.default_rng(2)
    values = generator.random(32) < 0.6
    share = Share.of(values, GROUPS)
    assert share.correlation(share) == pytest.approx(1)
    assert share.correlation(Share.of(~values, GROUPS)) == pytest.approx(-1)
    assert share.correlation(Share.of(values, np.char.upper(GROUPS))) == 0
    assert share.correlation(Share.of(np.ones(32), GROUPS)) == 0


def test_the_order_of_episodes_does_not_matter() -> None:
    values, mixed = np.arange(32) % 3 > 0, np.random.default_rng(3).permutation(32)
    assert Share.of(values, GROUPS).interval() == Share.of(values[mixed], GROUPS[mixed]).interval()


def test_a_single_group_sets_no_limits() -> None:
    share = Share.of([1, 0, 1], list("aaa"))
    assert (share.interval().low, share.interval().high) == (0, 1)
    assert share.variance == float("inf")
    assert share.correlation(share) == 0


def test_values_that_are_no_shares_are_refused() -> None:
    with pytest.raises(UsageError, match="no episodes"):
        Share.of([], [])
    with pytest.raises(UsageError, match="1 of 2 values are no shares, the first is nan"):
        Share.of([1, np.nan], list("ab"))
    with pytest.raises(UsageError, match=r"the first is 1\.5"):
        Share.of([1.5, 0], list("ab"))


@pytest.mark.parametrize(("hits", "trials"), [(3, 10), (50, 100), (170, 200), (199, 200)])
def test_an_accuracy_of_many_independent_groups_has_wilsons_interval(hits: int, trials: int) -> None:
    share = hits / trials
    low, high_of_errors = wilson_low(
        np.array([share, 1 - share]), np.full(2, float(trials)), stats.chi2.ppf(0.95, 1)
    )
    wilson = binomtest(hits, trials).proportion_ci(0.95, "wilson")
    np.testing.assert_allclose((low, 1 - high_of_errors), (wilson.low, wilson.high), atol=1e-6)


def test_where_all_groups_agree_an_accuracy_counts_groups() -> None:
    wilson = binomtest(12, 12).proportion_ci(0.95, "wilson")
    assert np.ravel(wilson_limits(np.full((1, 12), 8.0), np.full(12, 8.0))) == pytest.approx((wilson.low, 1.0))


def test_one_wrong_decision_of_96_hardly_widens_the_interval() -> None:
    groups = np.repeat(np.arange(12), 8)
    perfect, nearly = np.ones(96), np.ones(96)
    nearly[0] = 0
    lows = [Accuracy.of(values, groups).interval().low for values in (perfect, nearly)]
    assert lows[0] >= lows[1] > 0.75


@pytest.mark.parametrize("truth", [0.5, 0.75, 0.97])
@pytest.mark.parametrize("sizes", [np.full(12, 4), 2 * (1 + np.arange(24) % 8)], ids=["equal", "unequal"])
def test_intervals_of_accuracies_cover_their_share(truth: float, sizes: NDArray[np.int64]) -> None:
    generator = np.random.default_rng(1)
    groups = np.repeat(np.arange(sizes.size), sizes)
    covered = []
    for _ in range(600):
        chance = generator.beta(7 * truth / 3, 7 * (1 - truth) / 3, sizes.size)  # correlation 0.3
        interval = Accuracy.of(generator.random(groups.size) < chance[groups], groups).interval()
        covered.append(interval.low <= truth <= interval.high)
    assert np.mean(covered) > 0.92


@pytest.mark.slow
@pytest.mark.parametrize(("groups", "rate", "alike"), [(24, 0.97, 0.5), (40, 0.9, 1.0), (150, 0.03, 1.0)])
def test_success_rates_of_very_unequal_groups_are_covered(groups: int, rate: float, alike: float) -> None:
    generator = np.random.default_rng(0)
    sizes = np.minimum(30, np.ceil(2 / generator.random(groups)))
    odds = (1 / alike - 1) or 1e-9
    chance = generator.beta(rate * odds, (1 - rate) * odds, (400, groups))
    low, high = korn_graubard_limits(generator.binomial(sizes.astype(int), chance).astype(float), sizes)
    assert np.mean((low <= rate) & (rate <= high)) > 0.92


def test_one_group_that_fails_makes_a_success_rate_no_better_known() -> None:
    sizes = np.array([40, 30, 20, 10, 4, 2, 2, 2])
    groups = np.repeat(np.arange(8), sizes)
    lows = [Share.of(values, groups).interval().low for values in (np.ones(groups.size), groups < 7)]
    assert lows[0] >= lows[1]
