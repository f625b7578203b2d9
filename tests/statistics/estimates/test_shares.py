import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import binomtest

from probe_kit.errors import UsageError
from probe_kit.statistics.estimates.shares import (
    Accuracy,
    Share,
    effective_groups,
    group_shares,
    share_interval,
    wilson_interval,
)

GROUPS = np.repeat(list("abcdefgh"), 4)


@pytest.mark.parametrize(("hits", "trials"), [(0, 10), (3, 10), (17, 20), (40, 40), (1, 200)])
def test_independent_trials_have_clopper_and_pearsons_interval(hits: int, trials: int) -> None:
    share = hits / trials
    found = share_interval(share, share * (1 - share) / trials, trials, trials, trials - 1)
    exact = binomtest(hits, trials).proportion_ci(0.95, "exact")
    np.testing.assert_allclose(found, (exact.low, exact.high), atol=1e-9)


def test_twelve_of_twelve_groups_right_leave_a_quarter_open() -> None:
    low, high = share_interval(1.0, 0.0, 12, 48, 11)
    assert (float(low), float(high)) == pytest.approx((0.025 ** (1 / 12), 1.0))
    assert float(low) == pytest.approx(0.735, abs=5e-4)


def test_limits_of_many_shares_are_those_of_each() -> None:
    shares, variances = np.array([0.0, 0.3, 0.5, 0.99, 1.0]), np.array([0.0, 0.004, 0.0, 0.001, 0.0])
    together = share_interval(shares, variances, 20, 80, 19, tail=0.05)
    each = [share_interval(shares[row], variances[row], 20, 80, 19, tail=0.05) for row in range(5)]
    np.testing.assert_allclose(together, np.array(each).T)


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
    rest = sums - values.mean() * sizes
    assert share.variance == pytest.approx((rest**2).sum() * 24 / 23 / values.size**2)
    both, variances = group_shares(np.array([sums, sizes - sums]), sizes.astype(float))
    assert both.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(variances, share.variance)


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
    found = wilson_interval(share, share * (1 - share) / trials, trials, trials, 1e9)
    wilson = binomtest(hits, trials).proportion_ci(0.95, "wilson")
    np.testing.assert_allclose(found, (wilson.low, wilson.high), atol=1e-6)


def test_where_all_groups_agree_an_accuracy_counts_groups() -> None:
    wilson = binomtest(12, 12).proportion_ci(0.95, "wilson")
    assert np.ravel(wilson_interval(1.0, 0.0, 12, 96, 11)) == pytest.approx((wilson.low, 1.0))


@pytest.mark.parametrize("groups", [6, 12, 24, 150])
def test_limits_of_an_accuracy_never_rise_with_one_more_wrong_decision(groups: int) -> None:
    sizes = np.full(groups, 8.0)
    limits = []
    for wrong in range(groups // 2 + 1):
        accuracy = Accuracy(np.arange(groups).astype(str), sizes - (np.arange(groups) < wrong), sizes)
        limits.append((accuracy.interval().low, accuracy.interval().high))
    assert np.diff(limits, axis=0).max() <= 1e-12


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


@pytest.mark.parametrize("rate", [0.9, 0.97])
def test_success_rates_of_very_unequal_groups_are_covered(rate: float) -> None:
    generator = np.random.default_rng(0)
    sizes = 2 * np.ceil(20 * np.exp(-3 * np.linspace(0, 1, 24))).astype(int)
    groups = np.repeat(np.arange(24), sizes)
    covered = []
    for _ in range(400):
        chance = generator.beta(rate, 1 - rate, 24)  # correlation 1/2
        interval = Share.of(generator.random(groups.size) < chance[groups], groups).interval()
        covered.append(interval.low <= rate <= interval.high)
    assert np.mean(covered) > 0.92


def test_one_group_that_fails_makes_a_success_rate_no_better_known() -> None:
    sizes = np.array([40, 30, 20, 10, 4, 2, 2, 2])
    groups = np.repeat(np.arange(8), sizes)
    lows = [Share.of(values, groups).interval().low for values in (np.ones(groups.size), groups < 7)]
    assert lows[0] >= lows[1]
