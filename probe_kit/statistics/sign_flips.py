"""Family-wise tests (max-T) of many signed effects on the same items, by sign flips of groups."""

from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.statistics.paired_signs import unit_means

FLOOR = 1e-6
"""Metres added to every standard error: a site that nothing reads has effects of exactly 0, and a finite T."""
EXACT = 12
"""Up to so many groups every pattern of signs is tried; beyond, `DRAWS` of them."""
DRAWS = 2000


def max_t(
    values: NDArray[np.float64], items: ArrayLike, groups: ArrayLike, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """One-sided tests of S effects that are positive in the mean, together.

    values: (S, E) effect per episode. items, groups: (E,); an item's episodes are averaged, and the items of a
    group change signs together. seed: of the draws. Returns (S,) each: T = mean / (standard error + FLOOR), its p,
    and its p against the largest T of all S under the same signs (family-wise).
    """
    names, first = np.unique(np.asarray(items), return_index=True)
    means = unit_means(values, items)
    _, group_of = np.unique(np.asarray(groups)[first], return_inverse=True)
    signs = _signs(int(group_of.max()) + 1, seed)[:, group_of]
    root = np.sqrt(names.size)
    squares = (means**2).sum(axis=1)
    drawn = signs @ means.T / names.size
    spread = np.sqrt(np.maximum(squares / names.size - drawn**2, 0.0) * names.size / max(names.size - 1, 1))
    t = drawn / (spread / root + FLOOR)  # (draws, S); the first draw changes no sign
    observed = t[0]
    slack = 1e-9 * (1 + np.abs(observed))
    p = (t >= observed - slack).mean(axis=0)
    p_fwe = (t.max(axis=1)[:, None] >= observed - slack).mean(axis=0)
    return observed, np.asarray(p), np.asarray(p_fwe)


def smallest_flip_p(groups: int) -> float:
    """The smallest p-value of `max_t` with so many groups: one pattern of all that are tried."""
    return 0.5**groups if groups <= EXACT else 1 / DRAWS


def _signs(groups: int, seed: int) -> NDArray[np.float64]:
    """(draws, groups) of ±1, the first row all +1."""
    if groups <= EXACT:
        return np.array(list(product((1.0, -1.0), repeat=groups)))
    drawn = np.random.default_rng(seed).choice((1.0, -1.0), (DRAWS - 1, groups))
    return np.vstack([np.ones(groups), drawn])
