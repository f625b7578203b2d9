"""Intervals by resampling whole groups, also where every group agrees."""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.identity import derive_seed

Matrix = NDArray[np.float64]

Bounds = tuple[float, float]
"""The least and the largest value a score can have."""

SHARES: Bounds = (0.0, 1.0)
GAINS: Bounds = (-1.0, 1.0)
"""What the difference of two shares can be."""
DRAWS = 2000


def group_bootstrap(
    values: NDArray[np.floating] | NDArray[np.bool_],
    groups: ArrayLike,
    seed: int,
    draws: int = DRAWS,
    bounds: Bounds = SHARES,
) -> tuple[Matrix, Matrix]:
    """95 % interval of the mean over episodes, with whole groups resampled.

    values: (E, S), a score per episode in each of S columns, within `bounds`. groups: (E,). Returns low and high,
    (S,) each. Where all groups of a column agree resampling has no width and would claim certainty; see `unseen`.
    """
    return interval(bootstrap_means(values, groups, seed, draws, bounds), values.mean(axis=0))


def interval(draws: Matrix, value: Matrix) -> tuple[Matrix, Matrix]:
    """95 % percentile interval of (B, S) draws, (S,) low and high; it holds the (S,) `value` itself."""
    low, high = np.percentile(draws, [2.5, 97.5], axis=0)
    return np.minimum(low, value), np.maximum(high, value)


def bootstrap_means(
    values: NDArray[np.floating] | NDArray[np.bool_],
    groups: ArrayLike,
    seed: int,
    draws: int = DRAWS,
    bounds: Bounds = SHARES,
) -> Matrix:
    """Means over episodes in every draw of whole groups, (draws, S) from (E, S) values and (E,) groups.

    The same names of groups and seed draw the same groups, whatever the values. A column whose groups all agree
    is drawn from what `unseen` groups may hold.
    """
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    sums = np.zeros((names.size, values.shape[1]))
    np.add.at(sums, group_of, values.astype(np.float64))
    sizes = np.bincount(group_of).astype(np.float64)
    times = draw_groups(names.size, seed, draws)
    means: Matrix = (times @ sums) / (times @ sizes)[:, None]
    for column in np.flatnonzero(constant(means)):
        means[:, column] = unseen(float(means[0, column]), names.size, seed, draws, bounds)
    return means


def bootstrap_ratios(
    values: NDArray[np.floating], weights: NDArray[np.floating], groups: ArrayLike, seed: int, draws: int = DRAWS
) -> Matrix:
    """A conditional share in every draw of whole groups: (draws,) sums of values over sums of weights, (E,) each.

    values: at most the weights. NaN in a draw without weight. Draws that all agree come from what `unseen` groups
    may hold, as in `bootstrap_means`.
    """
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    tops, bottoms = (np.bincount(group_of, part, names.size) for part in (values, weights))
    times = draw_groups(names.size, seed, draws)
    below = (times @ bottoms).astype(np.float64)
    ratios: Matrix = np.full(draws, np.nan)
    np.divide(times @ tops, below, where=below > 0, out=ratios)
    known = ratios[below > 0]
    if constant(known[:, None])[0]:
        return unseen(float(known[0]), int((bottoms > 0).sum()), seed, draws)
    return ratios


def constant(draws: Matrix) -> NDArray[np.bool_]:
    """(S,) whether all (B, S) draws agree, up to rounding."""
    agree: NDArray[np.bool_] = np.ptp(draws, axis=0) < 1e-12
    return agree


def unseen(value: float, count: int, seed: int, draws: int = DRAWS, bounds: Bounds = SHARES) -> Matrix:
    """(draws,) means that `count` groups are consistent with that all have `value`.

    The share t of groups that are otherwise is Beta(1, count) given that none was seen: its 97.5 % point is that
    of Clopper and Pearson. They lie at either bound, by turns; at the value itself where that is a bound.
    """
    share = 1 - np.linspace(0, 1, draws) ** (1 / count)
    low, high = bounds
    ends = [end for end in (low, high) if abs(end - value) > 1e-9]
    end = np.resize(ends, draws)
    means: Matrix = value + share * (end - value)
    return np.random.default_rng(derive_seed("unseen", seed)).permutation(means)


def units_seed(names: ArrayLike, suite: str) -> int:
    """The seed by which groups or items of these names are drawn, wherever an interval is made of them.

    One number then has one interval, in whatever table it stands; and runs on the same units are paired.
    """
    return derive_seed("units", 0, suite, *np.unique(np.asarray(names)).tolist())


@lru_cache(maxsize=4)  # of one table: its groups and items, drawn for every number alike
def draw_groups(count: int, seed: int, draws: int = DRAWS) -> NDArray[np.int64]:
    """How often each of `count` groups is drawn, (draws, count), read-only."""
    times = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=draws)
    times.setflags(write=False)
    return times
