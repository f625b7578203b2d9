from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from probe_kit.errors import UsageError
from probe_kit.statistics.intervals import NO_LIMITS, Interval, difference_interval, mean_interval


def normal(value: float, error: float) -> Interval:
    return Interval(value - 1.96 * error, value + 1.96 * error)


@given(st.floats(-1, 1), st.floats(0.01, 1), st.floats(-1, 1), st.floats(0.01, 1), st.floats(-0.99, 0.99))
def test_symmetric_limits_give_the_normal_interval_of_a_difference(
    a: float, of_a: float, b: float, of_b: float, correlation: float
) -> None:
    found = difference_interval(a, normal(a, of_a), b, normal(b, of_b), correlation)
    error = np.sqrt(of_a**2 + of_b**2 - 2 * correlation * of_a * of_b)
    assert (found.low, found.high) == pytest.approx((a - b - 1.96 * error, a - b + 1.96 * error))


def test_skewed_limits_keep_their_sides() -> None:
    """Distances 0.3 and 0.4 give 0.5 below; 0.5 and 1.2 give 1.3 above."""
    found = difference_interval(1.0, Interval(0.7, 1.5), 2.0, Interval(0.8, 2.4))
    assert (found.low, found.high) == pytest.approx((-1.5, 0.3))


def test_the_same_estimate_twice_differs_by_exactly_nothing() -> None:
    found = difference_interval(0.4, Interval(0.2, 0.6), 0.4, Interval(0.2, 0.6), 1.0)
    assert (found.low, found.high) == pytest.approx((0, 0))


def test_a_difference_of_which_one_side_has_no_limits_has_none() -> None:
    assert difference_interval(1, NO_LIMITS, 0, Interval(-1, 1)) == NO_LIMITS
    assert difference_interval(1, Interval(0, 2), 0, Interval(-inf, 1)) == NO_LIMITS
    assert mean_interval([1, 2], [Interval(0, 2), NO_LIMITS]) == NO_LIMITS


def test_a_mean_of_equal_parts_is_narrower_by_the_root_of_their_number() -> None:
    found = mean_interval([0.5] * 16, [Interval(0.3, 0.6)] * 16)
    assert (found.low, found.high) == pytest.approx((0.45, 0.525))


def test_a_mean_of_shares_that_never_failed_stays_below_one() -> None:
    found = mean_interval([1.0] * 12, [Interval(0.735, 1.0)] * 12)
    assert (found.low, found.high) == pytest.approx((1 - 0.265 / np.sqrt(12), 1.0))


def test_no_estimates_and_impossible_correlations_are_refused() -> None:
    with pytest.raises(UsageError, match="no estimates"):
        mean_interval([], [])
    with pytest.raises(UsageError, match=r"correlation of 1\.5"):
        difference_interval(0, Interval(-1, 1), 0, Interval(-1, 1), 1.5)
