"""Scores above chance with their covariance, for one category or averaged over several."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from probe_kit.errors import UsageError
from probe_kit.statistics.estimates.balanced import CHANCE, Matrix
from probe_kit.statistics.estimates.crossfit import CrossFit
from probe_kit.statistics.estimates.shares import TAIL, wilson_interval
from probe_kit.statistics.intervals import Interval


@dataclass(frozen=True)
class Scores:
    """K scores above chance: above (K,), their covariance (K, K) and its degrees of freedom."""

    above: Matrix
    covariance: Matrix
    df: float

    @classmethod
    def of(cls, fit: CrossFit) -> "Scores":
        """The scores of one category."""
        return cls(fit.above, fit.covariance, fit.df)

    @classmethod
    def mean(cls, parts: Sequence["Scores"]) -> "Scores":
        """Means over categories that share no group: the covariances' sum over n².

        Degrees of freedom are (Σ v)² / Σ (v² / df), with v the sum of a category's variances (Satterthwaite, “An
        approximate distribution of estimates of variance components”, Biometrics Bulletin 2, 1946): a category
        that varies more than all others is known no better for them. Raises UsageError without categories.
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
    """The 95 % interval of the held-out accuracy ½ + c of one category's chosen site, by `wilson_interval`."""
    low, high = wilson_interval(
        CHANCE + fit.above[row], fit.covariance[row, row], fit.n_groups, fit.n_episodes, fit.df
    )
    return Interval(float(low), float(high))


def t_quantile(df: float, tail: float = TAIL) -> float:
    """Quantile 1 − tail of Student's t, by default 97.5 %."""
    from scipy.special import stdtrit  # type: ignore[import-untyped]

    return float(stdtrit(df, 1 - tail))
