from math import inf

import numpy as np
import pytest

from probe_kit.statistics.intervals import Interval, fieller_interval


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
