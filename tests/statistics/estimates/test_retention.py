import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import t

from probe_kit.statistics.estimates.balanced import GroupSums
from probe_kit.statistics.estimates.crossfit import Stream
from probe_kit.statistics.estimates.retention import Ratio, retention, retention_difference
from probe_kit.statistics.estimates.scores import Scores
from probe_kit.statistics.intervals import NO_LIMITS, difference_interval
from tests.support.inner_qualities import fitted, stream_of


def stream(seed: int, share: float, groups: int = 40, sites: int = 8) -> Stream:
    sums = np.random.default_rng(seed).binomial(4, share, (sites, groups)).astype(float)
    return stream_of(GroupSums(sums, np.full(groups, 4.0)), np.arange(sites))


def scores(expert: float, backbone: float, error: float = 0.03, df: float = 30) -> Scores:
    return Scores(np.array([expert, backbone]), np.diag([error**2, error**2]), df)


def test_the_limits_solve_fiellers_equation_with_errors_a_tenth_larger() -> None:
    found = Scores(np.array([0.12, 0.3]), np.array([[0.0010, 0.0003], [0.0003, 0.0012]]), 30)
    interval = retention(found).interval
    for ratio in (interval.low, interval.high):
        by = np.array([1, -ratio])
        assert (by @ found.above) ** 2 == pytest.approx((1.1 * t.ppf(0.975, 30)) ** 2 * by @ found.covariance @ by)
    assert interval.low < 0.4 < interval.high


def test_identical_streams_retain_exactly_all() -> None:
    one = stream(0, 0.75)
    found = retention(Scores.of(fitted(one, one)))
    assert (found.value, found.interval.low, found.interval.high) == pytest.approx((1, 1, 1))


def test_twelve_perfect_groups_leave_as_much_open_as_unseen_groups_may_hold() -> None:
    perfect = stream_of(GroupSums(np.full((5, 12), 4.0), np.full(12, 4.0)), np.arange(5))
    found = retention(Scores.of(fitted(perfect, perfect)))
    assert found.value == 1
    assert 0.6 < found.interval.high - found.interval.low < 0.8


def test_a_backbone_that_is_hardly_known_gives_no_limits() -> None:
    quantile = t.ppf(0.975, 30)
    just = 0.03 * quantile / 0.75
    assert retention(scores(0.05, just * 1.01)).interval.bounded
    assert retention(scores(0.05, just * 0.99)).interval == NO_LIMITS
    assert retention(scores(0.05, -0.2)) == Ratio(-0.25, NO_LIMITS)
    assert np.isnan(retention(scores(0.05, 0.0)).value)


def test_a_mean_is_the_ratio_of_the_means() -> None:
    parts = [scores(0.30, 0.40), scores(0.00, 0.10), scores(0.02, 0.01)]
    found = retention(Scores.mean(parts))
    assert found.value == pytest.approx(0.32 / 0.51)
    assert found.interval.bounded, "though two of the categories have no limits of their own"


def test_a_dead_expert_keeps_its_zero() -> None:
    covered = []
    for seed in range(120):
        fit = fitted(stream(seed, 0.5, 24), stream(seed + 1000, 0.8, 24))
        found = retention(Scores.of(fit))
        covered.append(found.interval.low <= 0 <= found.interval.high)
    assert np.mean(covered) > 0.9


def test_a_run_differs_from_itself_by_nothing() -> None:
    fit = fitted(stream(0, 0.6), stream(1, 0.75))
    found = retention_difference(Scores.of(fit), Scores.of(fit), fit.covariance_with(fit))
    assert found.value == 0
    alone = retention(Scores.of(fit)).interval
    assert found.interval.low <= 0 <= found.interval.high
    assert found.interval.high - found.interval.low < 0.4 * (alone.high - alone.low), "what is left is their skew"


def test_runs_on_other_groups_have_no_correlation() -> None:
    one, other = scores(0.2, 0.3), scores(0.1, 0.35)
    a, b = retention(one), retention(other)
    found = retention_difference(one, other)
    assert found.interval == difference_interval(a.value, a.interval, b.value, b.interval)
    assert found.value == a.value - b.value


def test_the_correlation_is_that_of_the_two_ratios() -> None:
    """Against ratios of many draws from the joint normal distribution."""
    joint = 1e-4 * np.array([[4, 1, 2, 0], [1, 5, 1, 2], [2, 1, 6, 1], [0, 2, 1, 4]])
    above = np.array([0.2, 0.4, 0.15, 0.35])
    drawn = np.random.default_rng(0).multivariate_normal(above, joint, 200_000)
    actual = np.corrcoef(drawn[:, 0] / drawn[:, 1], drawn[:, 2] / drawn[:, 3])[0, 1]
    one, other = Scores(above[:2], joint[:2, :2], 50), Scores(above[2:], joint[2:, 2:], 50)
    a, b = retention(one), retention(other)
    expected = difference_interval(a.value, a.interval, b.value, b.interval, actual)
    found = retention_difference(one, other, joint[:2, 2:]).interval
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=0.004)


def test_a_difference_with_an_unknown_backbone_has_no_limits() -> None:
    assert retention_difference(scores(0.2, 0.3), scores(0.2, 0.05)).interval == NO_LIMITS
    assert np.isnan(retention_difference(scores(0.2, 0.3), scores(0.2, 0.0), np.eye(2)).value)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.5, 0.9), st.floats(0.5, 0.9), st.integers(5, 40))
def test_limits_hold_the_value_or_there_are_none(seed: int, expert: float, backbone: float, groups: int) -> None:
    found = retention(Scores.of(fitted(stream(seed, expert, groups), stream(seed + 1, backbone, groups))))
    if found.interval.bounded:
        assert found.interval.low - 1e-9 <= found.value <= found.interval.high + 1e-9
    else:
        assert found.interval == NO_LIMITS
