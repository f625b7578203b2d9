"""Is it signal? Labels that could have been, and how often they score as well.

A relabelling treats an item as a whole, because its two layouts are the same question: under "the answer is
not encoded" every relabelling is as likely as the real labels, which makes the p-values exact.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def flip_items(labels: NDArray[np.bool_], items: ArrayLike, count: int, seed: int) -> NDArray[np.bool_]:
    """`count` relabellings (E, count) in which the labels of a random half of the items are all flipped.

    labels: (E,). items: (E,) item of every episode. Right for the correct side, which a suite draws freely.
    """
    names, item_of = np.unique(np.asarray(items), return_inverse=True)
    flips = np.random.default_rng(seed).random((names.size, count)) < 0.5
    flipped: NDArray[np.bool_] = labels[:, None] ^ flips[item_of]
    return flipped


def exchange_items(
    labels: NDArray[np.bool_], items: ArrayLike, layouts: ArrayLike, count: int, seed: int
) -> NDArray[np.bool_]:
    """`count` relabellings (E, count) in which items exchange their labels, layout by layout.

    labels: (E,). items, layouts: (E,). Only items present in the same layouts are exchanged. Keeps the share
    of every class, and so any side preference: right for the chosen side.
    """
    names, item_of = np.unique(np.asarray(items), return_inverse=True)
    kinds, layout_of = np.unique(np.asarray(layouts), return_inverse=True)
    row = np.full((names.size, kinds.size), -1)
    row[item_of, layout_of] = np.arange(labels.size)

    generator = np.random.default_rng(seed)
    exchanged = np.repeat(labels[:, None], count, axis=1)
    for present in np.unique(row >= 0, axis=0):
        rows = row[((row >= 0) == present).all(axis=1)][:, present]
        for draw in range(count):
            exchanged[rows, draw] = labels[rows[generator.permutation(len(rows))]]
    return exchanged


def site_p(observed: NDArray[np.float64], null: NDArray[np.float64]) -> NDArray[np.float64]:
    """p-value of every site on its own, (S,), from observed scores (S,) and null scores (S, P).

    NaN without a null.
    """
    return _p_value(observed, null)


def family_p(observed: NDArray[np.float64], null: NDArray[np.float64]) -> NDArray[np.float64]:
    """p-value of every site (S,) against the best of all: how often the maximum of a null curve is as high.

    The probability that any site without signal falls below 0.05 is then at most 0.05. NaN without a null.
    """
    return _p_value(observed, null.max(axis=0, keepdims=True) if observed.size else null)


def _p_value(observed: NDArray[np.float64], null: NDArray[np.float64]) -> NDArray[np.float64]:
    draws = null.shape[1]
    if draws == 0:
        return np.full(observed.shape, np.nan)
    # Scores are shares of episodes; the margin makes equal shares equal whatever the summation order.
    as_good = (null >= observed[:, None] - 1e-12).sum(axis=1)
    p: NDArray[np.float64] = (1 + as_good) / (1 + draws)
    return p
