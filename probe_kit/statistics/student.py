"""Student's intervals over groups: of the mean of a continuous quantity, and of R²."""

from math import exp, inf, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.statistics.bootstrap import GAINS, Bounds, group_bootstrap
from probe_kit.statistics.significance import SIGNIFICANCE


def student_interval(
    values: NDArray[np.floating], groups: ArrayLike, seed: int, bounds: Bounds = GAINS
) -> tuple[float, float]:
    """95 % interval of the mean over episodes, by Student's t with whole groups as the unit.

    values: (E,) measured, within `bounds`, at which the interval ends. groups: (E,). Of shares, which many groups
    have alike, `group_bootstrap` is the better one; it is taken, with `seed`, where all groups agree. A single
    group carries no information about others.
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
    """The same of (E,) values without bounds: of no width where all groups agree, infinite for a single group.

    tail: chance that the mean lies beyond one limit. With SIGNIFICANCE, each limit alone is a one-sided test.
    """
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    if names.size == 1:
        return -inf, inf
    mean, sizes = float(values.mean()), np.bincount(group_of)
    residuals = np.bincount(group_of, values) - mean * sizes
    spread = _reach(residuals, values.size, tail)
    return mean - spread, mean + spread


def explained_interval(
    scores: NDArray[np.floating], deviations: NDArray[np.floating], groups: ArrayLike, widening: float = 1.0
) -> tuple[float, float]:
    """Return an approximate 95 % interval of R², with whole groups as the unit; up to 1.

    scores: (n,), their mean is R²; see `explained_scores`. deviations: (n,) squared deviations of the labels from
    the mean that R² compares with, in any unit. R² is 1 − q with q = A / B, A the sum of squared errors and B that
    of the deviations. The variance of q is that of the ratio of two sums over groups (Cochran, “Sampling
    techniques”, 1977, section 6.13), v = Σ (a − q b)² · G / (G − 1) / B². The limits are 1 − q exp(± t √v / q),
    symmetric in log q. widening: factor of the standard error, SHARED_TRAINING for held-out scores of several
    folds. Minus infinity to 1 for a single group.
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
    reach = _reach(residuals, scores.size) * widening / missing
    low, high = 1 - missing * exp(min(reach, 100.0)), 1 - missing * exp(-reach)  # exp overflows from 710 on
    # The subtractions round: around a score of -5e-17, the limits of groups that all agree would both be 0.
    return min(low, explained), max(high, explained)


def _reach(residuals: NDArray[np.floating], count: int, tail: float = SIGNIFICANCE / 2) -> float:
    """Student's quantile times the standard error of a mean over `count` episodes of G groups.

    residuals: (G,) sums over the episodes of a group of the values without their mean. tail: beyond the quantile.
    """
    from scipy.special import stdtrit  # type: ignore[import-untyped]

    error = sqrt(float(residuals @ residuals) * residuals.size / (residuals.size - 1)) / count
    return float(stdtrit(residuals.size - 1, 1 - tail)) * error
