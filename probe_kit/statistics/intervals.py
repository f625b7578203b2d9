"""Intervals of shares, ratios (Fieller), differences and means (MOVER), with groups of items as the unit.

Success rates and other outcomes have Korn and Graubard's interval. Accuracies of probes have Wilson's. See `Share`
and `Accuracy`, and `share_limits` for the formulas.

Zou and Donner, “Construction of confidence limits about effect measures”, Statistics in Medicine 27 (2008).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf, isfinite, isinf, sqrt
from statistics import fmean

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit._system.types import Matrix
from probe_kit.errors import UsageError
from probe_kit.statistics.share_limits import (
    NEGLIGIBLE_VARIANCE,
    effective_groups,
    korn_graubard_limits,
    wilson_limits,
)


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
    """Return all ratios θ for which numerator − θ · denominator lies within `quantile` standard errors of zero.

    Where the denominator may be zero, on at least one side no ratio can be excluded, and the interval is
    unbounded.

    Args:
        numerator: Estimate of the numerator.
        denominator: Estimate of the denominator.
        covariance: (2, 2) covariance of (numerator, denominator).
        quantile: Quantile of the level, in standard errors.
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


def difference_interval(
    first: float, first_limits: Interval, second: float, second_limits: Interval, correlation: float = 0.0
) -> Interval:
    """Return the interval of `first` − `second`, at the level of the two intervals.

    a and b are the values, l and u their limits, and ρ is the correlation. Then low = a − b − √((a − l_a)² + (u_b
    − b)² − 2 ρ (a − l_a)(u_b − b)), and high has the other limits. There are no limits where either has none.

    Args:
        first: Value of the first estimate.
        first_limits: Interval of the first estimate.
        second: Value of the second estimate.
        second_limits: Interval of the second estimate, at the same level.
        correlation: Correlation of the two estimates; 0 where they share no group.

    Raises:
        UsageError: For a correlation outside −1 … 1.
    """
    if not -1 <= correlation <= 1:
        raise UsageError(f"a correlation of {correlation}; expected a number from -1 to 1")
    if not (first_limits.bounded and second_limits.bounded):
        return NO_LIMITS
    gap = first - second
    below = _combine_limits(first - first_limits.low, second_limits.high - second, correlation)
    above = _combine_limits(first_limits.high - first, second - second_limits.low, correlation)
    return Interval(gap - below, gap + above)


def mean_interval(values: Sequence[float], limits: Sequence[Interval]) -> Interval:
    """Return the interval of the mean of independent estimates, at the level of their intervals.

    The lower limit is mean − √(Σ (value − its low)²) / n, and the upper one alike. There are no limits where an
    estimate has none.

    Raises:
        UsageError: Without estimates.
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


def allowing_for_unseen_groups(
    covariance: float, variances: tuple[float, float], n_groups: int, most: float
) -> float:
    """Return the covariance of two estimates on the same groups, reduced where their difference is known too well.

    Two runs that agree in all G groups may differ in unseen ones: in a share t of them, by `most` each. As in
    `CrossFit.covariance`, t² is 2 / ((G + 1)(G + 2)) on average. The variance of the difference is at least t² ·
    most².
    """
    unseen = 2 * most**2 / ((n_groups + 1) * (n_groups + 2))
    return min(covariance, max(0.0, (sum(variances) - unseen) / 2))


def correlation_of(covariance: float, variances: tuple[float, float]) -> float:
    """Return the correlation of two estimates; 0 where one of them does not vary, or is of a single group."""
    scale = sqrt(variances[0] * variances[1]) if all(map(isfinite, variances)) else 0.0
    return max(-1.0, min(1.0, covariance / scale)) if scale > NEGLIGIBLE_VARIANCE else 0.0


def _combine_limits(first: float, second: float, correlation: float) -> float:
    return sqrt(max(0.0, first**2 + second**2 - 2 * correlation * first * second))


# -- shares --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Share:
    """A share of episodes, such as a success rate.

    Attributes:
        groups: (G,) names of the groups of items, sorted.
        sums: (G,) hits of each group.
        sizes: (G,) episodes of each group.
    """

    groups: NDArray[np.str_]
    sums: Matrix
    sizes: Matrix

    @classmethod
    def of(cls, values: ArrayLike, groups: ArrayLike, weights: ArrayLike | None = None) -> "Share":
        """Make the share from (E,) values from 0 to 1, one per episode.

        Args:
            values: (E,) values from 0 to 1.
            groups: (E,) name of every episode's group of items.
            weights: (E,) how much an episode counts, such as whether it has an answer; None counts each as 1.
                Groups without weight are left out.

        Raises:
            UsageError: For no episode, or a value that is NaN or outside 0 … 1.
        """
        each = np.asarray(values, np.float64)
        if weights is not None:
            counted = np.asarray(weights, np.float64)
            each, groups = each[counted > 0], np.asarray(groups, str)[counted > 0]
        if each.size == 0:
            raise UsageError("a share of no episodes; expected at least one")
        if not ((each >= 0) & (each <= 1)).all():
            wrong = each[~((each >= 0) & (each <= 1))]
            raise UsageError(
                f"{wrong.size} of {each.size} values are no shares, the first is {wrong[0]}; expected 0 to 1. "
                "Leave out episodes without a value."
            )
        names, group_of = np.unique(np.asarray(groups, str), return_inverse=True)
        weight: Matrix = np.ones(each.size) if weights is None else counted[counted > 0]
        sums, sizes = (np.bincount(group_of, part).astype(np.float64) for part in (each * weight, weight))
        return cls(names, sums, sizes)

    @property
    def value(self) -> float:
        """The share: hits over episodes."""
        return float(self.sums.sum() / self.sizes.sum())

    @property
    def n_groups(self) -> float:
        """The effective number of groups, G*: so many groups of equal size vary as little, E² / Σ size²."""
        return effective_groups(self.sizes)

    @property
    def df(self) -> float:
        """The degrees of freedom of the variance: G* − 1, at least 1."""
        return max(self.n_groups - 1, 1.0)

    @property
    def variance(self) -> float:
        """The variance of the share, groups as the unit; infinite with a single group."""
        return self.covariance(self)

    @cached_property
    def _residuals(self) -> Matrix:
        residuals: Matrix = (self.sums - self.value * self.sizes) / self.sizes.sum()
        return residuals

    def covariance(self, other: "Share") -> float:
        """Return the covariance of two shares on the same groups; 0 where the groups are not the same."""
        if not np.array_equal(self.groups, other.groups):
            return 0.0
        if self.groups.size == 1:
            return float("inf")
        return float(self._residuals @ other._residuals) * self.groups.size / (self.groups.size - 1)

    def correlation(self, other: "Share") -> float:
        """Return the correlation of two shares; 0 where the groups differ, or one share does not vary."""
        return correlation_of(self.covariance(other), (self.variance, other.variance))

    def difference(self, other: "Share") -> Interval:
        """The 95 % interval of this share minus another (MOVER), paired where both are of the same groups.

        Where the two agree in all groups, the interval leaves room for unseen ones, see
        `allowing_for_unseen_groups`.
        """
        related = 0.0
        if np.array_equal(self.groups, other.groups):
            variances = self.variance, other.variance
            shared = allowing_for_unseen_groups(self.covariance(other), variances, self.groups.size, 1.0)
            related = correlation_of(shared, variances)
        return difference_interval(self.value, self.interval(), other.value, other.interval(), related)

    def interval(self) -> Interval:
        """The 95 % interval by `korn_graubard_limits`; 0 to 1 with a single group."""
        if self.groups.size == 1:
            return Interval(0.0, 1.0)
        low, high = korn_graubard_limits(self.sums[None], self.sizes)
        return Interval(float(low[0]), float(high[0]))


class Accuracy(Share):
    """The held-out accuracy of a probe, with Wilson's interval.

    `sums` and `sizes` (G,) are the weights of the right and of all decisions of each group, as `balanced_sums`
    gives
    them.
    """

    def interval(self) -> Interval:
        """The 95 % interval by `wilson_limits`; 0 to 1 with a single group."""
        if self.groups.size == 1:
            return Interval(0.0, 1.0)
        low, high = wilson_limits(self.sums[None], self.sizes)
        return Interval(float(low[0]), float(high[0]))
