"""Confidence limits of shares of episodes, with groups of items as the unit: Korn and Graubard's, and Wilson's.

Both count effective episodes: E over the design effect, so that episodes that are alike within groups count as
fewer. One more error can make groups more alike, and so more effective episodes of them. It must not make a share
better known than fewer errors would: a limit is the lowest that these errors, or some of them, give. So limits
never rise with an added error.

Korn and Graubard, “Confidence intervals for proportions with small expected number of positive counts estimated
from survey data”, Survey Methodology 24 (1998).

Wilson, “Probable inference, the law of succession, and statistical inference”, Journal of the American Statistical
Association 22 (1927). Kish, “Survey sampling” (1965), for the design effect.
"""

from collections.abc import Callable
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit._system.types import Matrix
from probe_kit.statistics.significance import SIGNIFICANCE

TAIL = SIGNIFICANCE / 2
"""Chance of either side of a two-sided 95 % interval."""
NEGLIGIBLE_VARIANCE = 1e-12
"""A variance below this is the rounding of 0."""
_NEGLIGIBLE_SHARE = 1e-9
"""A share of errors below this is the rounding of none."""
_ALL = 1 - _NEGLIGIBLE_SHARE
"""A share of hits above this is 1 but for rounding."""
_MOST_STEPS = 512
"""Number of episodes up to which every smaller number of errors is tried; beyond, so many numbers."""

# -- effective numbers ---------------------------------------------------------------------------------------


def effective_groups(sizes: Matrix) -> float:
    """Return G* of (G,) sizes: so many groups of equal size vary as little, E² / Σ size²."""
    return float(sizes.sum() ** 2 / (sizes @ sizes))


def effective_episodes(
    shares: ArrayLike, variances: ArrayLike, n_episodes: float
) -> tuple[Matrix, NDArray[np.bool_]]:
    """Return min(s (1 − s) / v, E) for shares s with variances v, and whether all groups agree; of one shape.

    The first is E over the design effect (Kish 1965). It has no meaning where all groups agree.
    """
    s, v = np.broadcast_arrays(np.asarray(shares, np.float64).clip(0, 1), variances)
    agree = (v <= NEGLIGIBLE_VARIANCE) | (s <= 0) | (s >= 1)
    return _effective(s, v, n_episodes), agree


def group_shares(sums: Matrix, sizes: Matrix) -> tuple[Matrix, Matrix]:
    """Return shares and their variances, groups as the unit; (S,) each from (S, G) sums and (G,) sizes.

    variance = Σ (sum − share · size)² · G / (G − 1) / E², with E = Σ size. Two groups or more are needed.
    """
    total, count = sizes.sum(), sizes.size
    shares: Matrix = sums.sum(axis=1) / total
    residuals = sums - shares[:, None] * sizes
    variances: Matrix = (residuals**2).sum(axis=1) * count / (count - 1) / total**2
    return shares, variances


def exchangeable_variances(sums: Matrix, sizes: Matrix) -> Matrix:
    """Return the variances (S,) of shares, if all episodes of a group are equally alike, whatever its size.

    variance = (s (1 − s) Σ size² − Σ sum (size − sum)) · G / (G − 1) / E². Of equal groups it is that of
    `group_shares`. That is too small where the few groups with hits happen to be small ones: Σ sum · size, which
    these groups say least about, is taken to be s Σ size² here.
    """
    total, count = sizes.sum(), sizes.size
    shares: Matrix = sums.sum(axis=1) / total
    within = (sums * (sizes - sums)).sum(axis=1)
    variances: Matrix = (shares * (1 - shares) * (sizes @ sizes) - within) * count / (count - 1) / total**2
    return variances


# -- limits --------------------------------------------------------------------------------------------------


def korn_graubard_limits(sums: Matrix, sizes: Matrix, tail: float = TAIL) -> tuple[Matrix, Matrix]:
    """Return Clopper and Pearson's limits with the effective number of episodes, (S,) each.

    The method is that of Korn and Graubard (1998). The effective number is n = min(s (1 − s) / v, E) · (t(1 −
    tail, E − 1) / t(1 − tail, G* − 1))². The limits are Beta⁻¹(tail; s n, n − s n + 1) and Beta⁻¹(1 − tail; s n +
    1, n − s n). v is the larger one of `group_shares` and `exchangeable_variances`.

    G groups that are alike with chance p all agree with chance p^G. No share is better known than there.

    Args:
        sums: (S, G) hits of each group.
        sizes: (G,) episodes of each group; two groups or more.
        tail: Chance of either side.
    """
    from scipy.special import stdtrit  # type: ignore[import-untyped]

    total, df = float(sizes.sum()), max(effective_groups(sizes) - 1, 1.0)
    lost = float(stdtrit(max(total - 1, 1), 1 - tail) / stdtrit(df, 1 - tail)) ** 2
    perfect = tail ** (1 / sizes.size)

    def lowest(errors: Matrix) -> Matrix:
        shares, counting = _shares_of_fewer_errors(errors, sizes)
        share = 1 - errors.sum(axis=1) / total
        alike = exchangeable_variances(errors, sizes)
        few = np.minimum(_effective(share, alike, total), counting[:, -1])
        counting = np.column_stack([counting, few])
        return _below(perfect, share, total, _lowest_beta(np.column_stack([shares, share]), lost * counting, tail))

    return _both(sums, sizes, lowest)


def wilson_limits(sums: Matrix, sizes: Matrix, tail: float = TAIL) -> tuple[Matrix, Matrix]:
    """Return Wilson's limits (1927) with the effective number of episodes, (S,) each.

    n is min(s (1 − s) / v, E), with v of `group_shares`, and at least G*. With t the quantile of Student's
    distribution with G* − 1 degrees of freedom, the limits are (s + t²/2n ± t √(s (1 − s)/n + t²/4n²)) / (1 +
    t²/n).

    Where all groups are right, the variance knows nothing of other groups: n is G*, and t is the normal quantile.
    No accuracy is better known than there.

    Args:
        sums: (S, G) weights of the right decisions of each group.
        sizes: (G,) weights of all decisions of each group; two groups or more.
        tail: Chance of either side.
    """
    from scipy.special import stdtrit

    count = effective_groups(sizes)
    square = float(stdtrit(max(count - 1, 1.0), 1 - tail)) ** 2
    perfect = count / (count + NormalDist().inv_cdf(1 - tail) ** 2)

    def lowest(errors: Matrix) -> Matrix:
        shares, counting = _shares_of_fewer_errors(errors, sizes)
        low = wilson_low(shares, np.maximum(counting, count), square)
        share = 1 - errors.sum(axis=1) / sizes.sum()
        return _below(perfect, share, sizes.sum(), np.where(shares < _ALL, low, 1.0).min(axis=1))

    return _both(sums, sizes, lowest)


def wilson_low(shares: Matrix, counting: Matrix, square: float) -> Matrix:
    """Return Wilson's lower limits for shares of `counting` episodes; `square` is that of the quantile."""
    half = square / (2 * counting)
    low: Matrix = (shares + half - np.sqrt(square * shares * (1 - shares) / counting + half**2)) / (1 + 2 * half)
    return low.clip(0)


def _below(perfect: float, shares: Matrix, n_episodes: float, low: Matrix) -> Matrix:
    """Return lower limits of (S,) shares that are below `perfect`, that of a share of 1.

    The bound falls by a part in E² with every error, so that no share with an error is known as well as without.
    """
    bounded: Matrix = np.minimum(low, perfect * (1 - (1 - shares) / n_episodes))
    return np.where(shares < _ALL, bounded, perfect)


def _lowest_beta(shares: Matrix, counting: Matrix, tail: float) -> Matrix:
    """Return the lowest (S,) of Clopper and Pearson's lower limits for (S, K) shares of `counting` episodes."""
    from scipy.special import betainc, betaincinv

    hits, misses = np.maximum(shares * counting, _NEGLIGIBLE_SHARE), (1 - shares) * counting + 1
    hits = np.where(shares < _ALL, hits, np.inf)
    low: Matrix = np.where(shares[:, -1] > _NEGLIGIBLE_SHARE, betaincinv(hits[:, -1], misses[:, -1], tail), 0.0)
    # A limit is lower if more than `tail` lies below the one so far. That is faster to ask than all limits.
    rows, columns = np.nonzero(betainc(hits, misses, low[:, None]) > tail * (1 + 1e-9))
    np.minimum.at(low, rows, betaincinv(hits[rows, columns], misses[rows, columns], tail))
    return low


def _both(sums: Matrix, sizes: Matrix, lowest: Callable[[Matrix], Matrix]) -> tuple[Matrix, Matrix]:
    """Return lower limits of the share, and upper ones: 1 minus lower ones of the share of errors."""
    hits = sums.clip(0, sizes)
    errors = sizes - hits
    bound = _NEGLIGIBLE_SHARE * sizes.sum()
    low = np.where(hits.sum(axis=1) <= bound, 0.0, lowest(errors))
    high = np.where(errors.sum(axis=1) <= bound, 1.0, 1 - lowest(hits))
    return low, high


def _effective(shares: Matrix, variances: Matrix, n_episodes: float) -> Matrix:
    """Return min(s (1 − s) / v, E), which is E where nothing varies."""
    spread = shares * (1 - shares)
    varies = variances * n_episodes > spread
    number: Matrix = np.where(varies, spread / np.where(varies, variances, 1.0), n_episodes)
    return number


# -- some of the errors --------------------------------------------------------------------------------------


def _shares_of_fewer_errors(errors: Matrix, sizes: Matrix) -> tuple[Matrix, Matrix]:
    """Return the shares right (S, K) of 0, 1, … and all errors, with their fewest effective episodes.

    t of the errors x of a pattern may lie in any groups that have them, y ≤ x. With q = t / E, E² v is q² Σ size²
    + Σ y (y − 2 q size), but for the factor G / (G − 1). A group's part is convex in y, so it is at most y (x − 2
    q size). The largest sum of that is reached by the groups with the largest x − 2 q size. It is exact for t = Σ
    x, and does not fall with x.

    Args:
        errors: (S, G) errors of each group.
        sizes: (G,) episodes of each group.
    """
    total, count = float(sizes.sum()), sizes.size
    every = errors.sum(axis=1)
    step = max(1.0, total / _MOST_STEPS)
    numbers = np.minimum(step * np.arange(np.ceil(every.max(initial=0.0) / step - 1e-9) + 1), every[:, None])
    numbers[:, -1] = every
    q = numbers / total
    if np.ptp(sizes) <= NEGLIGIBLE_VARIANCE * total:
        # The same groups come first for every number.
        ordered = -np.sort(-errors, axis=1)
        zero = np.zeros((len(errors), 1))
        at, squares = (np.hstack([zero, part.cumsum(axis=1)]) for part in (ordered, ordered**2))
        sums = np.array([np.interp(*row) for row in zip(numbers, at, squares, strict=True)])
        sums = sums.reshape(numbers.shape) - 2 * q * numbers * sizes[0]
    else:
        sums = np.array([_largest_sums(*row, sizes) for row in zip(errors, numbers, q, strict=True)])
        sums = sums.reshape(numbers.shape)
    variances = np.maximum(q**2 * (sizes @ sizes) + sums, 0) * count / (count - 1) / total**2
    return 1 - q, _effective(q, variances, total)


def _largest_sums(errors: Matrix, numbers: Matrix, q: Matrix, sizes: Matrix) -> Matrix:
    """Return (K,) the largest sums over groups of y (x − 2 q size) with Σ y = t; see `_shares_of_fewer_errors`."""
    worth = errors - 2 * q[:, None] * sizes
    order = np.argsort(-worth, axis=1)
    worth, most = np.take_along_axis(worth, order, axis=1), errors[order]
    before = most.cumsum(axis=1) - most
    sums: Matrix = (worth * (numbers[:, None] - before).clip(0, most)).sum(axis=1)
    return sums
