"""Intervals over whole groups: by resampling, also where all groups agree, and by Student's t."""

from functools import lru_cache
from math import exp, inf, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit._system.types import Matrix
from probe_kit.hashing import derive_seed
from probe_kit.statistics.significance import SIGNIFICANCE

Bounds = tuple[float, float]
"""The least and the largest value that a score can have."""

SHARES: Bounds = (0.0, 1.0)
GAINS: Bounds = (-1.0, 1.0)
"""Bounds of a difference of two shares."""
BOOTSTRAP_DRAWS = 2000
"""Number of resamples of whole groups; with another number, every interval by resampling moves a little."""


def group_bootstrap(
    values: NDArray[np.floating] | NDArray[np.bool_],
    groups: ArrayLike,
    seed: int,
    draws: int = BOOTSTRAP_DRAWS,
    bounds: Bounds = SHARES,
) -> tuple[Matrix, Matrix]:
    """The 95 % interval of the mean over episodes, with whole groups resampled.

    Args:
        values: (E, S), a score per episode in each of S columns, within `bounds`.
        groups: (E,) group of items of every episode.
        seed: Seed of the resamples.
        draws: Number of resamples.
        bounds: The least and the largest value that a score can have.

    Returns:
        Low and high, (S,) each. Where groups agree, or all but a few, resampling claims more certainty than there
        is; see `widen_draws`.
    """
    value, each = values.mean(axis=0), group_means(values, groups)
    wide = widen_draws(bootstrap_means(values, groups, seed, draws), value, each, seed, bounds)
    return interval(wide, value)


def interval(draws: Matrix, value: Matrix) -> tuple[Matrix, Matrix]:
    """The 95 % percentile interval of (B, S) draws, (S,) low and high; it includes the (S,) `value` itself."""
    low, high = np.percentile(draws, [2.5, 97.5], axis=0)
    return np.minimum(low, value), np.maximum(high, value)


def bootstrap_means(
    values: NDArray[np.floating] | NDArray[np.bool_], groups: ArrayLike, seed: int, draws: int = BOOTSTRAP_DRAWS
) -> Matrix:
    """Return the means over episodes in every draw of whole groups, (draws, S) from (E, S) values and (E,) groups.

    With the same seed and the same names of groups, the same groups are drawn, whatever the values.
    """
    sums, sizes = _sums(values, groups)
    times = draw_groups(sizes.size, seed, draws)
    means: Matrix = (times @ sums) / (times @ sizes)[:, None]
    return means


def group_means(values: NDArray[np.floating] | NDArray[np.bool_], groups: ArrayLike) -> Matrix:
    """Return the (G, S) means of (E, S) values over the episodes of each group, sorted by the groups' names."""
    sums, sizes = _sums(values, groups)
    means: Matrix = sums / sizes[:, None]
    return means


def _sums(values: NDArray[np.floating] | NDArray[np.bool_], groups: ArrayLike) -> tuple[Matrix, Matrix]:
    """Return the (G, S) sums of (E, S) values over each group's episodes, and (G,) how many episodes it has."""
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    sums = np.zeros((names.size, values.shape[1]))
    np.add.at(sums, group_of, values.astype(np.float64))
    return sums, np.bincount(group_of).astype(np.float64)


def widen_draws(draws: Matrix, value: Matrix, each: Matrix, seed: int, bounds: Bounds = SHARES) -> Matrix:
    """Return the (B, S) draws, with no quantile nearer to the (S,) `value` than that of `unseen_quantiles`.

    Draws of groups contain nothing that was not observed. Where fifteen of sixteen groups agree, hardly any draw
    has three groups of the other kind. The interval would then be narrower than where all sixteen agree. Here, one
    group that differs moves both quantiles that are compared, and so the outer one, toward it.

    Draws keep their order, so that those of two runs on the same groups stay paired.

    Args:
        draws: (B, S) means of resampled groups.
        value: (S,) means over episodes.
        each: (G, S) means of the groups.
        seed: Seed of the order in which equal draws are ranked.
        bounds: The least and the largest value that a score can have.
    """
    mixed = np.random.default_rng(derive_seed("unseen", seed)).permutation(len(draws))
    order = mixed[np.argsort(draws[mixed].round(12), axis=0, kind="stable")]  # equal up to the rounding of sums
    ordered, least = np.take_along_axis(draws, order, axis=0), unseen_quantiles(value, each, len(draws), bounds)
    half = len(draws) // 2
    ordered[:half] = np.minimum(ordered[:half], least[:half])
    ordered[half:] = np.maximum(ordered[half:], least[half:])
    wide = np.empty_like(draws)
    np.put_along_axis(wide, order, ordered, axis=0)
    return wide


def unseen_quantiles(
    value: NDArray[np.floating], each: Matrix, draws: int = BOOTSTRAP_DRAWS, bounds: Bounds = SHARES
) -> Matrix:
    """The quantiles (draws, S), from least to largest, of a mean that unobserved groups could have.

    Unobserved groups may lie at either bound, with half of the chance each. Where the most common value lies at a
    bound, only the other bound is left and has all of the chance. Where all groups agree at a bound, this is
    Clopper and Pearson's interval.

    Args:
        value: (S,) means over episodes.
        each: (G, S) means of the groups.
        draws: Number of quantiles.
        bounds: The least and the largest value that a score can have.
    """
    tails = np.linspace(0, 1, draws, dtype=np.float64)[:, None]
    low, high = np.minimum(bounds[0], value), np.maximum(bounds[1], value)
    least_common, most_common = _commonest(each)
    below = reach(each, np.where(most_common >= high, 0.5, 1.0) * tails)
    above = reach(each, np.where(least_common <= low, 0.5, 1.0) * (1 - tails))
    least: Matrix = np.where(tails < 0.5, value - (value - low) * below, value + (high - value) * above)
    return least


def reach(each: NDArray[np.floating], tail: float | Matrix = SIGNIFICANCE / 2) -> Matrix:
    """The share of groups, (…, S), that may differ without having been observed, with chance `tail` per side.

    Where at most one group differs from most, it is the share of which nothing is observed with chance 2 · tail.
    At 0.025 that is about 3 / G. One group that differs says that such groups exist, and not what others are like.
    Where more differ, the next one may as well be like any of them. With k that differ, only one in k is like
    nothing observed.

    Args:
        each: (G, S) means of the groups.
        tail: Chance for either side, one number or an array (…, 1).
    """
    chance = np.minimum(2 * tail * np.maximum(unlike(each), 1), 1.0)
    share: Matrix = 1 - chance ** (1 / len(each))
    return share


def unlike(each: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return (S,) how many of (G, S) means of groups differ from the most common one."""
    # Rounded, because means of equal shares differ by the order in which they are summed.
    most = [np.unique(column, return_counts=True)[1].max() for column in each.round(9).T]
    return len(each) - np.array(most, np.int64)


def _commonest(each: NDArray[np.floating]) -> tuple[Matrix, Matrix]:
    """Return the least and the largest, (S,) each, of the most common values of (G, S) means of groups."""
    ends = []
    for column in each.round(9).T:
        values, counts = np.unique(column, return_counts=True)
        common = values[counts == counts.max()]
        ends.append((common[0], common[-1]))
    least, largest = np.array(ends, np.float64).T
    return least, largest


def units_seed(names: ArrayLike, seed_text: str) -> int:
    """The seed by which groups or items of these names are drawn for every interval.

    One number then has the same interval in every table, and runs on the same units are paired.

    Args:
        names: Names of the groups or items; their order and repetitions do not matter.
        seed_text: Text of the suite whose groups they are, see `suite.Suite.seed_text`.
    """
    return derive_seed("units", 0, seed_text, *np.unique(np.asarray(names)).tolist())


@lru_cache(maxsize=4)  # of one table: its groups and items, drawn for every number alike
def draw_groups(count: int, seed: int, draws: int = BOOTSTRAP_DRAWS) -> NDArray[np.int64]:
    """Return how often each of `count` groups is drawn, (draws, count), read-only."""
    times = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=draws)
    times.setflags(write=False)
    return times


# -- by Student's t ------------------------------------------------------------------------------------------


def student_interval(
    values: NDArray[np.floating], groups: ArrayLike, seed: int, bounds: Bounds = GAINS
) -> tuple[float, float]:
    """The 95 % interval of the mean over episodes, by Student's t with whole groups as the unit.

    For shares, which many groups have alike, `group_bootstrap` is better. It is used, with `seed`, where all
    groups agree. A single group carries no information about others: its interval is `bounds`.

    Args:
        values: (E,) measured values, within `bounds`.
        groups: (E,) group of items of every episode.
        seed: Seed of the resamples where all groups agree.
        bounds: The least and the largest possible value; the interval ends there.
    """
    if np.unique(np.asarray(groups)).size == 1:
        return bounds
    low, high = unbounded_student_interval(values, groups)
    if high - low < 1e-12:
        agreed = group_bootstrap(values[:, None], groups, seed, bounds=bounds)
        return float(agreed[0][0]), float(agreed[1][0])
    return max(bounds[0], low), min(bounds[1], high)


def unbounded_student_interval(
    values: NDArray[np.floating], groups: ArrayLike, tail: float = SIGNIFICANCE / 2
) -> tuple[float, float]:
    """The interval of `student_interval` without bounds.

    It has no width where all groups agree, and is infinite for a single group.

    Args:
        values: (E,) measured values.
        groups: (E,) group of items of every episode.
        tail: Chance that the mean lies beyond one limit. With SIGNIFICANCE, each limit alone is a one-sided test.
    """
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    if names.size == 1:
        return -inf, inf
    mean, sizes = float(values.mean()), np.bincount(group_of)
    residuals = np.bincount(group_of, values) - mean * sizes
    spread = _student_reach(residuals, values.size, tail)
    return mean - spread, mean + spread


def explained_interval(
    scores: NDArray[np.floating], deviations: NDArray[np.floating], groups: ArrayLike, widening: float = 1.0
) -> tuple[float, float]:
    """Return an approximate 95 % interval of R², with whole groups as the unit; up to 1.

    R² is 1 − q with q = A / B, where A is the sum of squared errors and B that of the deviations. The variance of
    q is that of the ratio of two sums over groups: v = Σ (a − q b)² · G / (G − 1) / B² (Cochran, “Sampling
    techniques”, 1977, section 6.13). The limits are 1 − q exp(± t √v / q), symmetric in log q. For a single group
    they are minus infinity and 1.

    Args:
        scores: (n,) scores whose mean is R²; see `explained_scores`.
        deviations: (n,) squared deviations of the labels from the mean that R² compares with, in any unit.
        groups: (n,) group of items of every score.
        widening: Factor of the standard error; SHARED_TRAINING for held-out scores of several folds.
    """
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    if names.size == 1:
        return -inf, 1.0
    explained, varying = float(scores.mean()), float(deviations.mean())
    missing = 1 - explained
    if missing <= 0:
        return 1.0, 1.0
    relative = deviations / varying if varying > 0 else np.ones(scores.size)
    residuals = np.asarray(np.bincount(group_of, (1 - scores) - missing * relative), dtype=np.float64)
    reach = _student_reach(residuals, scores.size) * widening / missing
    low, high = 1 - missing * exp(min(reach, 100.0)), 1 - missing * exp(-reach)  # exp overflows from 710 on
    # The subtractions round: around a score of -5e-17, the limits of groups that all agree would both be 0.
    return min(low, explained), max(high, explained)


def _student_reach(residuals: NDArray[np.floating], count: int, tail: float = SIGNIFICANCE / 2) -> float:
    """Return Student's quantile times the standard error of a mean over `count` episodes of G groups.

    Args:
        residuals: (G,) sums over a group's episodes of the values minus their mean.
        count: Number of episodes.
        tail: Chance beyond the quantile.
    """
    from scipy.special import stdtrit  # type: ignore[import-untyped]

    error = sqrt(float(residuals @ residuals) * residuals.size / (residuals.size - 1)) / count
    return float(stdtrit(residuals.size - 1, 1 - tail)) * error
