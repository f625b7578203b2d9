"""Retention with its interval: the score of the action above chance, as a share of the backbone's."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan, sqrt

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit.errors import UsageError
from probe_kit.statistics.crossfit import CrossFit
from probe_kit.statistics.intervals import (
    NO_LIMITS,
    Interval,
    difference_interval,
    fieller_interval,
)
from probe_kit.statistics.share_limits import TAIL, wilson_limits

_DIGITS = 9
"""Digits to which sums of groups are equal: those of tied sites differ by the rounding of means."""

# -- scores above chance -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scores:
    """K scores above chance.

    Attributes:
        above: (K,) scores above chance.
        covariance: (K, K) covariance of the scores.
        df: Degrees of freedom of the covariance.
    """

    above: Matrix
    covariance: Matrix
    df: float

    @classmethod
    def of(cls, fit: CrossFit) -> "Scores":
        """Return the scores of one category."""
        return cls(fit.above, fit.covariance, fit.df)

    @classmethod
    def mean(cls, parts: Sequence["Scores"]) -> "Scores":
        """Return the means over categories that share no group.

        Their covariance is the sum of the covariances over n². The degrees of freedom are (Σ v)² / Σ (v² / df),
        with v the sum of a category's variances. So a category that varies more than all others is not known
        better because of them. See Satterthwaite, “An approximate distribution of estimates of variance
        components”, Biometrics Bulletin 2 (1946).

        Raises:
            UsageError: Without categories.
        """
        if not parts:
            raise UsageError("the mean of no categories; expected at least one")
        above = np.mean([part.above for part in parts], axis=0)
        covariance = np.sum([part.covariance for part in parts], axis=0) / len(parts) ** 2
        df = np.array([part.df for part in parts], np.float64)
        spread = np.array([np.trace(part.covariance) for part in parts])
        varies = spread.sum() > 0
        return cls(above, covariance, float(spread.sum() ** 2 / (spread**2 / df).sum() if varies else df.sum()))


def accuracy_interval(fit: CrossFit, row: int) -> Interval:
    """The 95 % interval of the held-out accuracy ½ + c of one category's chosen site.

    Every resample chooses sites, whose accuracy has limits by `wilson_limits`. The lower limit is the mean of the
    lower half of these, the upper one that of the upper half. So the interval also holds what the choice adds, and
    no limit rises with an added error.
    """
    choices, times = np.unique(fit.choice_sums[row].round(_DIGITS), axis=0, return_counts=True)
    lows, highs = wilson_limits(choices, fit.sizes[row])
    return Interval(_mean_of_lower_half(lows, times), -_mean_of_lower_half(-highs, times))


def _mean_of_lower_half(values: Matrix, times: NDArray[np.intp]) -> float:
    """Return the mean of the lower half of (U,) values that occur so many `times` each."""
    order = np.argsort(values)
    weights = np.diff(np.minimum(times[order].cumsum(), times.sum() / 2), prepend=0.0)
    return float(values[order] @ weights / weights.sum())


def t_quantile(df: float, tail: float = TAIL) -> float:
    """Return the quantile 1 − tail of Student's t, by default 97.5 %."""
    from scipy.special import stdtrit  # type: ignore[import-untyped]

    return float(stdtrit(df, 1 - tail))


# -- their ratio ---------------------------------------------------------------------------------------------

LEAST_KNOWN = 0.25
"""Share of the backbone's score that the lower end of its 95 % interval must reach.

A score that may be a quarter of its estimate makes the upper limit of a ratio four times as large.
"""
WELL_KNOWN = 0.5
"""The same share, from which on the limits are Fieller's; below, they are wider, see `retention`."""
OTHER_TRAINING = 1.1
"""Factor of the standard errors of both scores, for what other training questions would change.

A group also influences a score through the probes of the other folds, which no variance over tested groups
includes. Without the factor, intervals cover 90.8 % at least in seven simulated settings of 480 draws, with it
94.2 % (`benchmarks/retention_coverage.py`).
"""


@dataclass(frozen=True)
class Ratio:
    """A value with its 95 % interval, which may have no limits."""

    value: float
    interval: Interval


def retention(scores: Scores) -> Ratio:
    """Return the first score over the second one, (expert, backbone), with Fieller's limits (Fieller 1954).

    Of a mean over categories it is the ratio of the mean scores. The limits allow for other training questions,
    see OTHER_TRAINING. NaN where the backbone's score is exactly 0.

    A backbone that is not known well has limits only where its score is too high by chance, and then Fieller's
    cover too rarely. Let the lower end of its interval be a share k of its score. From WELL_KNOWN down to
    LEAST_KNOWN the distances of the limits grow by (WELL_KNOWN − LEAST_KNOWN) / (k − LEAST_KNOWN), without a jump,
    until there are none.
    """
    expert, backbone = float(scores.above[0]), float(scores.above[1])
    value = expert / backbone if backbone else nan
    quantile = t_quantile(scores.df)
    low = backbone - quantile * sqrt(scores.covariance[1, 1])
    least_share = low / backbone if backbone > 0 else 0.0
    if least_share <= LEAST_KNOWN:
        return Ratio(value, NO_LIMITS)
    interval = fieller_interval(expert, backbone, scores.covariance[:2, :2], quantile * OTHER_TRAINING)
    if not interval.bounded or least_share >= WELL_KNOWN:
        return Ratio(value, interval)
    times = (WELL_KNOWN - LEAST_KNOWN) / (least_share - LEAST_KNOWN)
    return Ratio(value, Interval(value - times * (value - interval.low), value + times * (interval.high - value)))


def retention_difference(first: Scores, second: Scores, between: Matrix | None = None) -> Ratio:
    """Return the retention of the first minus that of the second, with MOVER's limits.

    Args:
        first: Scores (expert, backbone) of a run, or their means over categories.
        second: Those of another run, or of another mean.
        between: (2, 2) covariance of the first's (expert, backbone) with the second's, where both are of the same
            groups; see `CrossFit.covariance_with`. For means it is the sum over categories divided by n². None for
            other groups.
    """
    a, b = retention(first), retention(second)
    correlation = 0.0 if between is None else _correlation(first, second, between)
    interval = difference_interval(a.value, a.interval, b.value, b.interval, correlation)
    return Ratio(a.value - b.value, interval)


def _correlation(first: Scores, second: Scores, between: Matrix) -> float:
    """Return the correlation of two ratios by the delta method.

    It is 0 where one of them is not defined or does not vary.
    """
    if not (first.above[1] and second.above[1]):
        return 0.0
    by_first, by_second = _slope(first), _slope(second)
    variances = [by @ scores.covariance[:2, :2] @ by for by, scores in ((by_first, first), (by_second, second))]
    scale = sqrt(max(0.0, float(variances[0] * variances[1])))
    return float(np.clip(by_first @ between @ by_second / scale, -1, 1)) if scale > 0 else 0.0


def _slope(scores: Scores) -> Matrix:
    """Return the derivatives (2,) of the ratio by its two scores."""
    expert, backbone = scores.above[:2]
    slope: Matrix = np.array([1.0, -expert / backbone]) / backbone
    return slope
