"""Tests of paired differences on the same episodes or items, exact or by exchange, and their corrections.

Groups of items are the unit: items that share pictures are not independent.
"""

from collections.abc import Callable, Hashable, Sequence
from itertools import product
from math import comb, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit._system.types import Matrix
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.statistics.label_permutations import p_value
from probe_kit.statistics.significance import SIGNIFICANCE

# -- controls and other models -------------------------------------------------------------------------------

EXCHANGES = 999
"""Number of drawn exchanges: with the observed one 1,000, so that no p is below 0.001."""
SHARED_DECISIONS = sqrt(1 + 2 / pi)
"""Factor, 1.28, by which cross-validation widens the spread of an accuracy beyond that of its groups.

Exchanges of groups take groups to be independent, and they are not. Any two groups of different folds train the
probe of each other, and how similar their features are is a part of the decision values of both. Let G groups
train a probe. The similarity to one of them then is 1 / G of the variance of a decision value, and two groups are
correlated by ρ = 1 / G. So the sum over groups has twice the variance of independent groups.

Decisions are right where a decision value exceeds a limit, in a share a of the episodes. They are correlated by
ρ φ(z)² / (a (1 − a)) with z = Φ⁻¹(a), the first term of Pearson's series (Philosophical Transactions A 195, 1900).
That is 2 ρ / π at a = ½, and less elsewhere: the factor would be 1.24 at 0.75 and 1.16 at 0.9. It is the most that
there can be, of decision values in which the training groups decide all but the signal.
"""
SHARED_PROBE = 1.25
"""The same factor of differences of squared errors, by simulation.

Without it, one of two networks that know a quantity equally well exceeds the other in 6 to 14 % of experiments,
with it in 2 to 6 % (`benchmarks/label_coverage.py`).
"""
KNOWING = 0.05
"""Accuracy above chance from which on a control is taken to know something, see `_widening`."""


def better_than_reference(
    correct: NDArray[np.bool_] | Matrix,
    reference: Matrix,
    groups: ArrayLike,
    seed: int,
    widening: float | None = None,
    chance: float = CHANCE,
) -> Matrix:
    """Return the family-wise p (S,) that a site's mean score is higher than one control's.

    If a site is no better, a group is as likely to favour it as to oppose it. So the signs of the groups'
    differences are drawn anew, the same for all sites, and the largest of them counts. Decisions must also be
    better than chance by the same test: see `_widening`.

    Args:
        correct: (S, E) scores, such as whether a held-out decision is right.
        reference: (E,) score of the control in each episode.
        groups: (E,) group of items of every episode.
        seed: Seed of the signs.
        widening: Factor of the drawn differences; SHARED_PROBE of R². None for decisions.
        chance: Mean score of guessing, for decisions.
    """
    gain = _group_sums(correct - reference, groups)
    factor = _widening(float(reference.mean()), chance) if widening is None else widening
    p = _flipped_p(gain, seed, factor)
    return p if widening is not None else np.maximum(p, _above_chance_p(correct, groups, seed, chance))


def better_than_best(
    correct: NDArray[np.bool_] | Matrix,
    references: NDArray[np.bool_] | Matrix,
    groups: ArrayLike,
    seed: int,
    widening: float | None = None,
    chance: float = CHANCE,
) -> Matrix:
    """Return the family-wise p (S,) that a site's mean score is higher than that of another model's best site.

    If the models are alike, a group's scores could as well have come from either. So whole groups change places,
    and both best sites are chosen anew.

    Args:
        correct: (S, E) scores, such as whether a held-out decision is right.
        references: (S', E) scores of the other model's sites on the same episodes.
        groups: (E,) group of items of every episode.
        seed: Seed of the exchanges.
        widening: Factor of the drawn differences, as in `better_than_reference`.
        chance: Mean score of guessing, for decisions.
    """
    sums, reference_sums = _group_sums(correct, groups), _group_sums(references, groups)
    stays = (np.random.default_rng(seed).random((sums.shape[1], EXCHANGES)) < 0.5).astype(float)
    # A model that keeps its own groups and takes the other's elsewhere, site by site.
    shared = min(len(sums), len(reference_sums))
    mixed_here = _mix_sums(sums, reference_sums[_matching(len(sums), shared)], stays)
    mixed_there = _mix_sums(reference_sums, sums[_matching(len(reference_sums), shared)], stays)
    null = mixed_here.max(axis=0) - mixed_there.max(axis=0)
    best = float(np.asarray(references, np.float64).mean(axis=1).max())
    factor = _widening(best, chance) if widening is None else widening
    p = p_value(sums.sum(axis=1) - reference_sums.sum(axis=1).max(), factor * null[None, :])
    return p if widening is not None else np.maximum(p, _above_chance_p(correct, groups, seed, chance))


def _widening(reference: float, chance: float) -> float:
    """Return the factor of the drawn differences of decisions from a control of this score.

    Of two networks that both guess none exceeds the other, because a site must be better than chance too, and
    that is tested with the factor. Of a control that knows something the factor is SHARED_DECISIONS. Between, its
    square grows with the control's score above chance, up to KNOWING. So a control that knows nothing hides
    little of what a site knows. `benchmarks/score_coverage.py` counts how often both tests together find a
    difference where there is none.
    """
    knows = min(max((reference - chance) / KNOWING, 0.0), 1.0)
    return sqrt(1 + knows * (SHARED_DECISIONS**2 - 1))


def _above_chance_p(correct: NDArray[np.bool_] | Matrix, groups: ArrayLike, seed: int, chance: float) -> Matrix:
    """Return the family-wise p (S,) that decisions are better than chance."""
    return _flipped_p(_group_sums(correct - np.float64(chance), groups), seed, SHARED_DECISIONS)


def _flipped_p(gains: Matrix, seed: int, factor: float) -> Matrix:
    """Return the family-wise p (S,) that the sums of (S, G) gains are positive, by drawn signs of the groups."""
    signs = np.where(np.random.default_rng(seed).random((gains.shape[1], EXCHANGES)) < 0.5, -1.0, 1.0)
    return p_value(gains.sum(axis=1), factor * (gains @ signs).max(axis=0, keepdims=True))


def _mix_sums(sums: Matrix, other: Matrix, stays: Matrix) -> Matrix:
    """Return the sums (S, draws) over groups, of `sums` where a group `stays` and of `other` elsewhere."""
    mixed: Matrix = sums @ stays + other @ (1 - stays)
    return mixed


def _matching(count: int, shared: int) -> NDArray[np.intp]:
    """Return the other model's site for each of `count` sites: the one of the same number, or the last."""
    matching: NDArray[np.intp] = np.minimum(np.arange(count), shared - 1)
    return matching


def _group_sums(values: NDArray[np.bool_] | Matrix, groups: ArrayLike) -> Matrix:
    """Return the sums (S, G) of (S, E) values over the episodes of each group."""
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    sums = np.zeros((len(values), names.size))
    np.add.at(sums.T, group_of, values.T.astype(np.float64))
    return sums


# -- exact tests ---------------------------------------------------------------------------------------------


def heads_p(heads: int, tosses: int) -> float:
    """Return the chance of at least so many heads in the tosses of a fair coin; 1.0 without any."""
    return float(sum(comb(tosses, count) for count in range(heads, tosses + 1)) / 2**tosses)


def sign_p(more: int, less: int) -> float:
    """Return the exact two-sided p that `more` against `less` is a fair coin's; 1.0 without any.

    For episodes that only one condition got right against those that only the other did, it is McNemar's exact
    test.
    """
    return min(1.0, 2 * heads_p(max(more, less), more + less))


ROUNDING = 1e-9
"""Effects so small (in metres) come from the order of sums, and have no sign."""


def unit_means(values: NDArray[np.float64], units: ArrayLike) -> NDArray[np.float64]:
    """Return the means of (…, E) values over the episodes of each unit, (…, U), sorted by the units' names."""
    names, unit_of = np.unique(np.asarray(units), return_inverse=True)
    means = np.stack([values[..., unit_of == unit].mean(axis=-1) for unit in range(names.size)], axis=-1)
    return np.asarray(means, np.float64)


def greater_p(effects: NDArray[np.float64]) -> float:
    """Return the chance that at least so many of the effects (U,) are positive, if each sign were a fair coin's.

    Effects that are zero, up to rounding, take no part; 1 where there is none.
    """
    positive, negative = int((effects > ROUNDING).sum()), int((effects < -ROUNDING).sum())
    return heads_p(positive, positive + negative)


def paired_greater_p(values: NDArray[np.float64], items: ArrayLike, groups: ArrayLike) -> float:
    """Return the larger p of `greater_p` over items and over groups.

    Items that share pictures are not independent.

    Args:
        values: (E,) effect per episode.
        items: (E,) item of every episode.
        groups: (E,) group of items of every episode.
    """
    return max(greater_p(unit_means(values, units)) for units in (items, groups))


Right = NDArray[np.bool_]
"""Whether each item is right, (N,)."""


def mcnemar_p(first: Right, second: Right) -> float:
    """Return the exact two-sided p of two ways of answering the same items being right equally often.

    Only items on which they differ count, each as a toss of a fair coin; 1 where there is none.
    """
    # scipy's rather than `sign_p`, which differs in the last digits: stored numbers are compared bit for bit.
    from scipy.stats import binomtest  # type: ignore[import-untyped]

    more, fewer = int((first & ~second).sum()), int((~first & second).sum())
    return 1.0 if more + fewer == 0 else float(binomtest(more, more + fewer, 0.5).pvalue)


def flip_p(first: Right, second: Right, groups: ArrayLike) -> float:
    """Return the exact two-sided p of `mcnemar_p` with a group of items as one toss.

    All differences in a group turn together.

    Args:
        first: (N,) whether the first way is right.
        second: (N,) whether the second way is right.
        groups: (N,) group of every item.
    """
    return flip_gains_p(first.astype(np.int64) - second, groups)


def flip_gains_p(gains: NDArray[np.int64], groups: ArrayLike) -> float:
    """Return the exact two-sided p that (N,) gains, in whole units, have no direction.

    The gains of a group turn together. The distribution of the sum of gains over all flips of signs is added up
    group by group. So no draw is needed, for any number of groups.

    Args:
        gains: (N,) differences of two conditions, in whole units.
        groups: (N,) group of every gain.
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
    """Return the exact 95 % interval of a share; (0, 1) without trials."""
    from scipy.stats import beta

    low = 0.0 if hits == 0 else float(beta.ppf(SIGNIFICANCE / 2, hits, trials - hits + 1))
    high = 1.0 if hits == trials else float(beta.ppf(1 - SIGNIFICANCE / 2, hits + 1, trials - hits))
    return low, high


def fisher_p(first: Right, second: Right) -> float:
    """Return the exact two-sided p that two properties of the same items are independent."""
    from scipy.stats import fisher_exact

    table = [[int((first & second).sum()), int((first & ~second).sum())],
             [int((~first & second).sum()), int((~first & ~second).sum())]]  # fmt: skip
    return float(fisher_exact(table).pvalue)


def overlap_p(first: Right, second: Right, strata: ArrayLike, seed: int, draws: int = 10_000) -> float:
    """Return the two-sided p that two properties are independent within each stratum.

    `second` is dealt anew within each stratum, and the overlap is counted.
    """
    names, stratum_of = np.unique(np.asarray(strata), return_inverse=True)
    generator = np.random.default_rng(seed)
    drawn = np.zeros(draws)
    for stratum in range(names.size):
        members = stratum_of == stratum
        hits, marked, size = int(second[members].sum()), int(first[members].sum()), int(members.sum())
        drawn += generator.hypergeometric(marked, size - marked, hits, draws) if size else 0
    observed, middle = float((first & second).sum()), drawn.mean()
    as_far = np.abs(drawn - middle) >= abs(observed - middle) - 1e-9
    return float((as_far.sum() + 1) / (draws + 1))


# -- corrections ---------------------------------------------------------------------------------------------


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Return Holm's family-wise p of each; None stays None and takes no part."""
    order = sorted((p, position) for position, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    highest = 0.0
    for rank, (p, position) in enumerate(order):
        highest = max(highest, min(1.0, (len(order) - rank) * p))
        corrected[position] = highest
    return corrected


def holm_corrected[Row](
    rows: Sequence[Row],
    p: Callable[[Row], float | None],
    summary: Callable[[Row], bool] = lambda _: False,
    test: Callable[[Row], Hashable] | None = None,
) -> list[float | None]:
    """Return Holm's family-wise p of every row, in order; None where a row has no p.

    Args:
        rows: Rows of a table.
        p: Function that returns a row's own p, or None.
        summary: Function that returns whether a row is over several categories; such rows are a family of their
            own.
        test: Function that returns what a row tests. Several rows of one test, such as the views of one success
            rate, count once. None: each row is a test of its own.
    """
    tests = list(range(len(rows))) if test is None else [test(row) for row in rows]
    corrected_of: dict[Hashable, float | None] = {}
    for over_all in (False, True):
        family = {name: p(row) for name, row in zip(tests, rows, strict=True) if summary(row) == over_all}
        corrected_of |= zip(family, holm(list(family.values())), strict=True)
    return [corrected_of[name] for name in tests]


# -- many effects together -----------------------------------------------------------------------------------

FLOOR = 1e-6
"""Metres added to every standard error, so that T is finite at a site that nothing reads.

The effects at such a site are exactly 0.
"""
EXACT = 12
"""Number of groups up to which every pattern of signs is tried; beyond, `SIGN_PATTERNS` are drawn."""
SIGN_PATTERNS = 2000
"""Number of drawn patterns of signs, or of places.

The observed ones are among them, so that no p is below 1 / 2,000.
"""


def max_t(
    values: NDArray[np.float64], items: ArrayLike, groups: ArrayLike, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Test together, one-sided, whether S effects are positive in the mean.

    An item's episodes are averaged, and the items of a group change signs together.

    Args:
        values: (S, E) effect per episode.
        items: (E,) item of every episode.
        groups: (E,) group of items of every episode.
        seed: Seed of the draws of signs.

    Returns:
        (S,) each: T = mean / (standard error + FLOOR), its p, and its family-wise p: against the largest T of all
        S under the same signs.
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
    slack = 1e-9 * (1 + np.abs(observed))  # a T that is equal but for rounding is as large
    p = (t >= observed - slack).mean(axis=0)
    p_fwe = (t.max(axis=1)[:, None] >= observed - slack).mean(axis=0)
    return observed, np.asarray(p), np.asarray(p_fwe)


def least_column_p(values: NDArray[np.float64], groups: ArrayLike, seed: int) -> float:
    """Return the one-sided chance that the first of K exchangeable columns lies so far below the others' mean.

    The place of the first column is drawn anew, the same in all rows of a group. Any column may be the first where
    none differs. With two columns it is a test by signs. The level is exact, because the observed places are one
    of the draws.

    Args:
        values: (E, K) values, with K at least 2.
        groups: (E,) group of items of every episode.
        seed: Seed of the draws.
    """
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    columns = values.shape[1]
    treated = (values.sum(axis=1, keepdims=True) - values) / (columns - 1)
    gains = np.zeros((names.size, columns))
    np.add.at(gains, group_of, treated - values)
    places = np.random.default_rng(seed).integers(columns, size=(SIGN_PATTERNS, names.size))
    places[0] = 0
    drawn = gains[np.arange(names.size), places].sum(axis=1)
    return float((drawn >= drawn[0] - 1e-9 * (1 + abs(drawn[0]))).mean())


def smallest_flip_p(groups: int) -> float:
    """Return the smallest p-value of `max_t` with so many groups: one pattern of all that are tried."""
    return 0.5**groups if groups <= EXACT else 1 / SIGN_PATTERNS


def _signs(groups: int, seed: int) -> NDArray[np.float64]:
    """Return the signs (draws, groups) of ±1, the first row all +1."""
    if groups <= EXACT:
        return np.array(list(product((1.0, -1.0), repeat=groups)))
    drawn = np.random.default_rng(seed).choice((1.0, -1.0), (SIGN_PATTERNS - 1, groups))
    return np.vstack([np.ones(groups), drawn])
