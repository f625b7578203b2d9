"""Exact tests of two conditions on the same episodes."""

from math import comb

import numpy as np
from numpy.typing import NDArray


def sign_p(more: int, less: int) -> float:
    """Exact two-sided p that `more` against `less` is a fair coin's; 1.0 without any.

    Of episodes that one condition alone got right against those the other alone did, it is McNemar's exact test.
    """
    trials, most = more + less, max(more, less)
    tail = sum(comb(trials, heads) for heads in range(most, trials + 1)) / 2**trials
    return float(min(1.0, 2 * tail))


def grouped_sign_p(difference: NDArray[np.int_], groups: NDArray[np.str_]) -> float:
    """The same with a group as the unit, so that items that share pictures count once.

    difference: (E,) per episode 1, 0 or -1, by which condition was right. groups: (E,).
    """
    _, group_of = np.unique(groups, return_inverse=True)
    lead = np.bincount(group_of, weights=difference)
    return sign_p(int((lead > 0).sum()), int((lead < 0).sum()))
