"""Exact one-sided tests of a signed effect, paired by item."""

from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray

ROUNDING = 1e-9
"""Effects so small (metres) come from the order of sums, and have no sign."""


def unit_means(values: NDArray[np.float64], units: ArrayLike) -> NDArray[np.float64]:
    """Mean of (…, E) values over the episodes of each unit, (…, U) in the order of their names."""
    names, unit_of = np.unique(np.asarray(units), return_inverse=True)
    means = np.stack([values[..., unit_of == unit].mean(axis=-1) for unit in range(names.size)], axis=-1)
    return np.asarray(means, np.float64)


def greater_p(effects: NDArray[np.float64]) -> float:
    """Chance that at least so many of the effects (U,) are positive, if each sign were a fair coin's.

    Effects that are zero, up to rounding, take no part; 1 where there is none.
    """
    positive, negative = int((effects > ROUNDING).sum()), int((effects < -ROUNDING).sum())
    trials = positive + negative
    return float(sum(comb(trials, heads) for heads in range(positive, trials + 1)) / 2**trials)


def paired_greater_p(values: NDArray[np.float64], items: ArrayLike, groups: ArrayLike) -> float:
    """The same by item and by group, the larger of the two: items that share pictures are not independent.

    values: (E,) effect per episode. items, groups: (E,).
    """
    return max(greater_p(unit_means(values, units)) for units in (items, groups))
