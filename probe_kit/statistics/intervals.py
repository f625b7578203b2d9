"""Intervals of ratios (Fieller), and of differences and means from the intervals of their parts (MOVER).

Zou and Donner, “Construction of confidence limits about effect measures”, Statistics in Medicine 27 (2008).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite, isinf, sqrt
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError


@dataclass(frozen=True)
class Interval:
    """Limits of a confidence interval; an infinite limit means that the data set none."""

    low: float
    high: float

    @property
    def bounded(self) -> bool:
        """Whether both limits are finite."""
        return not (isinf(self.low) or isinf(self.high))

    def __str__(self) -> str:
        return f"[{self.low:.2f}, {self.high:.2f}]" if self.bounded else "[no limits]"


def fieller_interval(
    numerator: float, denominator: float, covariance: NDArray[np.float64], quantile: float
) -> Interval:
    """All ratios θ for which numerator − θ · denominator lies within `quantile` standard errors of zero.

    covariance: (2, 2) of (numerator, denominator). When the denominator may be zero no ratio can be excluded on
    one side at least, and the interval is unbounded.
    """
    cut = quantile**2
    square = denominator**2 - cut * covariance[1, 1]
    if square <= 0:
        return Interval(-inf, inf)
    middle = numerator * denominator - cut * covariance[0, 1]
    constant = numerator**2 - cut * covariance[0, 0]
    spread = sqrt(max(0.0, middle**2 - square * constant))
    return Interval(float((middle - spread) / square), float((middle + spread) / square))


NO_LIMITS = Interval(-inf, inf)
NEGLIGIBLE_VARIANCE = 1e-12
"""A variance below this is the rounding of 0."""


def difference_interval(
    first: float, first_limits: Interval, second: float, second_limits: Interval, correlation: float = 0.0
) -> Interval:
    """Interval of `first` − `second`, at the level of the two intervals.

    correlation: of the two estimates; 0 where they share no group. With a, b the values, l, u their limits and ρ
    the correlation: low = a − b − √((a − l_a)² + (u_b − b)² − 2 ρ (a − l_a)(u_b − b)), high with the other limits.
    No limits where either has none. Raises UsageError for a correlation outside −1 … 1.
    """
    if not -1 <= correlation <= 1:
        raise UsageError(f"a correlation of {correlation}; expected a number from -1 to 1")
    if not (first_limits.bounded and second_limits.bounded):
        return NO_LIMITS
    gap = first - second
    below = _combined(first - first_limits.low, second_limits.high - second, correlation)
    above = _combined(first_limits.high - first, second - second_limits.low, correlation)
    return Interval(gap - below, gap + above)


def mean_interval(values: Sequence[float], limits: Sequence[Interval]) -> Interval:
    """Interval of the mean of independent estimates, at the level of their intervals.

    low = mean − √(Σ (value − its low)²) / n, high alike. No limits where one of them has none. Raises UsageError
    without estimates.
    """
    if not values:
        raise UsageError("the mean of no estimates; expected at least one")
    if not all(interval.bounded for interval in limits):
        return NO_LIMITS
    pairs = list(zip(values, limits, strict=True))
    below = sqrt(sum((value - interval.low) ** 2 for value, interval in pairs)) / len(pairs)
    above = sqrt(sum((interval.high - value) ** 2 for value, interval in pairs)) / len(pairs)
    middle = fmean(values)
    return Interval(middle - below, middle + above)


def not_surer(covariance: float, variances: tuple[float, float], n_groups: int, most: float) -> float:
    """The covariance of two estimates on the same groups, less where their difference would be known too well.

    Two runs that agree in all G groups may differ in unseen ones: in a share t of them, by `most`
    each. As in `CrossFit.covariance` t² is 2 / ((G + 1)(G + 2)) on average, and the variance of the difference is
    at least t² · most².
    """
    unseen = 2 * most**2 / ((n_groups + 1) * (n_groups + 2))
    return min(covariance, max(0.0, (sum(variances) - unseen) / 2))


def correlation_of(covariance: float, variances: tuple[float, float]) -> float:
    """Correlation of two estimates; 0 where one of them does not vary, or is of a single group."""
    scale = sqrt(variances[0] * variances[1]) if all(map(isfinite, variances)) else 0.0
    return max(-1.0, min(1.0, covariance / scale)) if scale > NEGLIGIBLE_VARIANCE else 0.0


def _combined(first: float, second: float, correlation: float) -> float:
    return sqrt(max(0.0, first**2 + second**2 - 2 * correlation * first * second))
