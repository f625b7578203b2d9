"""Exact tests of correct against wrong on the same items, with groups of items as the unit."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.statistics.significance import SIGNIFICANCE

Right = NDArray[np.bool_]
"""(N,) whether each item is right."""


def mcnemar_p(first: Right, second: Right) -> float:
    """Exact two-sided p of two ways of answering the same items being right equally often.

    Only items on which they differ count, each as a toss of a fair coin; 1 where there is none.
    """
    from scipy.stats import binomtest  # type: ignore[import-untyped]

    more, fewer = int((first & ~second).sum()), int((~first & second).sum())
    return 1.0 if more + fewer == 0 else float(binomtest(more, more + fewer, 0.5).pvalue)


def flip_p(first: Right, second: Right, groups: ArrayLike) -> float:
    """Exact two-sided p of the same, where the items of a group are one toss: all their differences turn together.

    groups: (N,).
    """
    return flip_gains_p(first.astype(np.int64) - second, groups)


def flip_gains_p(gains: NDArray[np.int64], groups: ArrayLike) -> float:
    """Exact two-sided p that (N,) gains, in whole units, have no direction; those of a group turn together.

    groups: (N,). The distribution of the sum of gains over all flips of signs is added up group by group, so that
    no draw is needed for any number of groups.
    """
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    totals_of = np.zeros(names.size, np.int64)
    np.add.at(totals_of, group_of, gains)
    sizes = np.abs(totals_of[totals_of != 0])
    shares = np.ones(1)
    for size in sizes:
        spread = np.zeros(shares.size + 2 * size)
        spread[: shares.size] += shares / 2
        spread[2 * size :] += shares / 2
        shares = spread
    totals = np.arange(shares.size) - int(sizes.sum())
    return min(1.0, float(shares[np.abs(totals) >= abs(int(gains.sum()))].sum()))


def clopper_pearson(hits: int, trials: int) -> tuple[float, float]:
    """Exact 95 % interval of a share; (0, 1) without trials."""
    from scipy.stats import beta

    low = 0.0 if hits == 0 else float(beta.ppf(SIGNIFICANCE / 2, hits, trials - hits + 1))
    high = 1.0 if hits == trials else float(beta.ppf(1 - SIGNIFICANCE / 2, hits + 1, trials - hits))
    return low, high


def fisher_p(first: Right, second: Right) -> float:
    """Exact two-sided p of two properties of the same items having nothing to do with each other."""
    from scipy.stats import fisher_exact

    table = [[int((first & second).sum()), int((first & ~second).sum())],
             [int((~first & second).sum()), int((~first & ~second).sum())]]  # fmt: skip
    return float(fisher_exact(table).pvalue)


def overlap_p(first: Right, second: Right, strata: ArrayLike, seed: int, draws: int = 10_000) -> float:
    """Two-sided p of the same over several strata: `second` is dealt anew within each, the overlap is counted."""
    names, stratum_of = np.unique(np.asarray(strata), return_inverse=True)
    generator = np.random.default_rng(seed)
    drawn = np.zeros(draws)
    for stratum in range(names.size):
        own = stratum_of == stratum
        hits, marked, size = int(second[own].sum()), int(first[own].sum()), int(own.sum())
        drawn += generator.hypergeometric(marked, size - marked, hits, draws) if size else 0
    observed, middle = float((first & second).sum()), drawn.mean()
    further = np.abs(drawn - middle) >= abs(observed - middle) - 1e-9
    return float((further.sum() + 1) / (draws + 1))


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Holm's family-wise p of each; None stays None and takes no part."""
    order = sorted((p, place) for place, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    highest = 0.0
    for rank, (p, place) in enumerate(order):
        highest = max(highest, min(1.0, (len(order) - rank) * p))
        corrected[place] = highest
    return corrected
