"""Comparison of two groups of models, with the model as the unit."""

from collections.abc import Sequence
from itertools import combinations
from math import comb, inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.statistics.intervals import NO_LIMITS, Interval
from probe_kit.statistics.significance import SIGNIFICANCE

MOST_EXACT = 200_000
"""Number of ways of exchanging labels up to which all are tried; beyond, `EXCHANGES` of them are drawn."""
TWO_MODELS = 0.5
"""Share of the other group's spread that two models may have.

With it, p ≤ 0.05 is given in 4 to 6 % of groups of 2 + 8 and 2 + 12 models whose true spreads are 2 : 1 to 5 : 1,
and without it in 8 to 11 % (`benchmarks/verdict_coverage.py --only spreads`).
"""
EXCHANGES = 20_000
"""Number of drawn exchanges of labels, with which no p is below 1 / 20,001."""


class ModelsP(NamedTuple):
    """The p-value of a comparison of two groups of models.

    Attributes:
        p: Two-sided p over models.
        smallest: The least p that so few models allow.
        exact: Whether all ways of exchanging labels were tried.
    """

    p: float
    smallest: float
    exact: bool


def exchange_p(first: Sequence[float], second: Sequence[float], seed: int = 0) -> ModelsP:
    """Return the p of two groups of models having equal distributions, with their labels exchanged in all ways.

    The statistic is the difference of the means. A small p may also come from unequal spreads, where the sizes
    differ too; see `is_exchangeable`. With 3 + 3 models, p cannot be below 0.1.

    Args:
        first: One value per model of the first group.
        second: One value per model of the second group.
        seed: Seed of the draws where there are more ways than `MOST_EXACT`.

    Raises:
        UsageError: For an empty group or a value that is not finite.
    """
    values, size = _values(first, second), len(first)
    ways = comb(values.size, size)
    turned = 2 if 2 * size == values.size else 1  # the same split with the labels exchanged has the same gap
    if ways <= MOST_EXACT:
        members = np.array(list(combinations(range(values.size), size)))
        gaps = _gaps(values, values[members].sum(axis=1), size)
        return ModelsP(float((gaps >= gaps[0] - _slack(values)).mean()), turned / ways, True)
    generator = np.random.default_rng(seed)
    sums = generator.permuted(np.tile(values, (EXCHANGES, 1)), axis=1)[:, :size].sum(axis=1)
    gaps, observed = _gaps(values, sums, size), _gaps(values, values[:size].sum(keepdims=True), size)[0]
    hits = int((gaps >= observed - _slack(values)).sum())
    return ModelsP((hits + 1) / (EXCHANGES + 1), 1 / (EXCHANGES + 1), False)


def is_exchangeable(first: Sequence[float], second: Sequence[float]) -> bool:
    """Return whether `exchange_p` holds its level for the difference of the means of two groups.

    With unequal sizes it does where the smaller group has no larger spread. Otherwise, a spread five times as
    large gives p ≤ 0.05 in 22 to 36 % of groups of equal means. Two models may have a small spread by chance, so
    theirs must be at most `TWO_MODELS` of the other one. A group of one model has no spread of its own, and
    passes.

    With equal sizes it does unless the spreads are very different: 1 : 5 gives p ≤ 0.05 in 7 to 9 % of groups of
    4 + 4 to 6 + 6 models. So their variances must not differ by the two-sided F test. With three models or fewer
    no p is below 0.05.
    """
    few, many = sorted((first, second), key=len)
    spreads = [float(np.std(group, ddof=1)) if len(group) > 1 else 0.0 for group in (few, many)]
    if len(few) == len(many):
        return len(few) < 4 or _alike(spreads, len(few) - 1)
    return spreads[0] <= (TWO_MODELS if len(few) == 2 else 1.0) * spreads[1]


def _alike(spreads: Sequence[float], df: int) -> bool:
    """Return whether two spreads of equal groups do not differ by the two-sided F test."""
    from scipy.special import fdtrc  # type: ignore[import-untyped]

    small, large = sorted(spreads)
    if large == 0:
        return True
    return small > 0 and bool(2 * fdtrc(df, df, (large / small) ** 2) >= SIGNIFICANCE)


def welch_interval(first: Sequence[float], second: Sequence[float], largest: float = inf) -> Interval:
    """Return the 95 % interval of the first group's mean minus the second's, by Welch's t over models.

    A group of one model has no spread of its own; that of the other group is used (Student's t). No limits where
    both groups have one model, or where no model differs from its group. Raises as `exchange_p`.

    Args:
        first: One value per model of the first group.
        second: One value per model of the second group.
        largest: The difference that no two means can exceed, 1 for rates. Limits beyond it are cut there; where
            both are, there are none.
    """
    from scipy.special import stdtrit

    _values(first, second)
    sizes = np.array([len(first), len(second)])
    spreads = [float(np.var(group, ddof=1)) if len(group) > 1 else None for group in (first, second)]
    measured = [spread for spread in spreads if spread is not None]
    if not measured or max(measured) == 0:
        return NO_LIMITS
    of_mean = np.array([measured[0] if spread is None else spread for spread in spreads]) / sizes
    if len(measured) == 1:
        df = float(sizes.max() - 1)
    else:
        df = float(of_mean.sum() ** 2 / (of_mean**2 / (sizes - 1)).sum())
    gap = float(np.mean(first) - np.mean(second))
    spread = float(stdtrit(df, 1 - SIGNIFICANCE / 2)) * sqrt(of_mean.sum())
    if spread >= largest + abs(gap):
        return NO_LIMITS
    return Interval(max(gap - spread, -largest), min(gap + spread, largest))


def _values(first: Sequence[float], second: Sequence[float]) -> NDArray[np.float64]:
    values = np.array([*first, *second], np.float64)
    if not (len(first) and len(second)):
        raise UsageError(f"groups of {len(first)} and {len(second)} models; expected at least one model in each")
    if not np.isfinite(values).all():
        raise UsageError(
            f"values {values.tolist()} of models; expected finite numbers. Leave out models without one."
        )
    return values


def _gaps(values: NDArray[np.float64], sums: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return the absolute differences of the means where the first group's values add up to `sums`."""
    gaps: NDArray[np.float64] = np.abs(sums / size - (values.sum() - sums) / (values.size - size))
    return gaps


def _slack(values: NDArray[np.float64]) -> float:
    """Return the difference below which gaps are equal up to the rounding of sums."""
    return 1e-12 * max(1.0, float(np.abs(values).max()))
