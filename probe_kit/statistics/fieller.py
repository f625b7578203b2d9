"""Fieller interval of a ratio of two correlated means."""

from dataclasses import dataclass
from math import inf, isinf, sqrt

import numpy as np
from numpy.typing import NDArray


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
    rest = numerator**2 - cut * covariance[0, 0]
    spread = sqrt(max(0.0, middle**2 - square * rest))
    return Interval(float((middle - spread) / square), float((middle + spread) / square))
