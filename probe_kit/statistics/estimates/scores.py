"""Scores above chance with their covariance, for one category or averaged over several."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from probe_kit.errors import UsageError
from probe_kit.statistics.estimates.balanced import CHANCE, Matrix
from probe_kit.statistics.estimates.crossfit import CrossFit
from probe_kit.statistics.estimates.shares import TAIL, wilson_interval
from probe_kit.statistics.fieller import Interval


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
        """Means over categories that share no group: the covariances' sum over n², degrees of freedom added.

        Raises UsageError without categories.
        """
        if not parts:
            raise UsageError("the mean of no categories; expected at least one")
        above = np.mean([part.above for part in parts], axis=0)
        covariance = np.sum([part.covariance for part in parts], axis=0) / len(parts) ** 2
        return cls(above, covariance, sum(part.df for part in parts))

    def accuracy_interval(self, row: int) -> Interval:
        """Student's 95 % interval of the accuracy, ½ + score, for means over categories; within 0 … 1."""
        spread = t_quantile(self.df) * sqrt(self.covariance[row, row])
        accuracy = CHANCE + float(self.above[row])
        return Interval(max(0.0, accuracy - spread), min(1.0, accuracy + spread))


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
