"""Cross-fitted scores: a site is chosen on one half of the groups and scored on the other half."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.errors import TooFewGroupsError, UsageError
from probe_kit.statistics.estimates.balanced import CHANCE, GroupSums, Matrix

Sides = NDArray[np.int8]
"""(R, G): the half that a group belongs to in each of R splits, 1 or −1; 0 for a group that takes no part."""

REPEATS = 100
"""Splits of all groups, over which a score is averaged."""
HALVINGS = 100
"""Halvings of the groups, from which the covariance is measured."""
REPEATS_OF_HALF = 10
"""Splits of each half of a halving."""
FEWEST_GROUPS = 4
"""A half of a half needs a group to choose on and one to score on."""
_AT_ONCE = 256
"""Splits in memory at once: a matrix of so many columns and a few hundred sites fits into the cache."""
_EQUAL = 1e-9
"""Sums closer than this differ by rounding only."""


@dataclass(frozen=True)
class Stream:
    """The sites of one stream. They are scored by their sums and chosen by the guide, (S, G)."""

    scores: GroupSums
    guide: Matrix

    @classmethod
    def of(cls, scores: GroupSums, layers: ArrayLike, iterations: ArrayLike | None = None) -> "Stream":
        """Sites at (S,) layers and (S,) iterations, in any order.

        A stream that runs once is chosen by its sums. With several iterations the guide is half a site's sums and
        half those of its surroundings, smoothed along layers and iterations. Raises UsageError for another number
        of places than of sites, or no site.
        """
        at = np.asarray(layers)
        steps = np.zeros_like(at) if iterations is None else np.asarray(iterations)
        if not len(scores.sums) == at.size == steps.size or at.size == 0:
            raise UsageError(
                f"{at.size} layers and {steps.size} iterations for {len(scores.sums)} sites; expected one each, "
                "and at least one site"
            )
        if np.unique(steps).size < 2:
            return cls(scores, scores.sums)
        return cls(scores, (scores.sums + smoothing(at, steps) @ scores.sums) / 2)

    @property
    def peak(self) -> float:
        """Accuracy of the most accurate site, above what choosing it will hold up to."""
        return float(self.scores.accuracies.max())


@dataclass(frozen=True)
class CrossFit:
    """Cross-fitted scores of K streams on the same groups.

    above: (K,) mean held-out accuracy of the chosen sites, above chance. peaks: (K,) accuracy of the site that
    is best on all groups, scored on them too. differences: (K, HALVINGS) score on one half of the groups minus
    score on the other. n_groups, n_episodes: G and E. seed: of the halvings; equal seeds and groups have equal
    halvings.
    """

    above: Matrix
    peaks: Matrix
    differences: Matrix
    n_groups: int
    n_episodes: float
    seed: int

    @property
    def covariance(self) -> Matrix:
        """(K, K) of `above`, where no score is known better than unseen groups allow.

        Half of the mean square difference between halves is the variance at half the size; half of that is the
        variance at full size. A share t of groups at chance costs t of a score above chance. Where all G groups
        agree, t² is 2 / ((G + 1)(G + 2)) on average; a variance is at least that times the squared score.
        """
        found = self.covariance_with(self)
        unseen = 2 / ((self.n_groups + 1) * (self.n_groups + 2)) * self.above**2
        np.fill_diagonal(found, np.maximum(found.diagonal(), unseen))
        return found

    @property
    def df(self) -> int:
        """Degrees of freedom of the covariance: a group less, and at most half of the halvings."""
        return min(self.n_groups - 1, HALVINGS // 2)

    def covariance_with(self, other: "CrossFit") -> Matrix:
        """(K, L) covariance with the scores of `other`; 0 where the two have other halvings, so other groups.

        Equal seeds stand for equal groups: make the seed from the groups' names.
        """
        if (self.seed, self.n_groups) != (other.seed, other.n_groups):
            return np.zeros((self.above.size, other.above.size))
        covariance: Matrix = self.differences @ other.differences.T / HALVINGS / 4
        return covariance


def crossfit(streams: Sequence[Stream], seed: int, chance: float = CHANCE) -> CrossFit:
    """Choose each stream's best site on half of the groups and score it on the other half, both ways, 100 times.

    streams: on the same groups, in the same order. seed: of the halvings; derive it from the suite and the names
    of the groups (`units_seed`), so that neither other categories nor the order of work change a number, and so
    that runs on the same groups stay paired. chance: 0 for sums from which the chance of every site is subtracted
    already. Sites that are equally good share the choice, so that their order does not matter. Raises
    TooFewGroupsError for fewer than 4 groups, and UsageError for NaN or streams on other groups.
    """
    n_groups = _check(streams)
    whole, parts = _splits(n_groups, seed)
    above, differences = [], []
    for stream in streams:
        above.append(held_out_scores(stream, whole).mean() - chance)
        of_half = held_out_scores(stream, parts).reshape(HALVINGS, 2, REPEATS_OF_HALF).mean(axis=2)
        differences.append(of_half[:, 0] - of_half[:, 1])
    peaks = np.array([stream.peak for stream in streams])
    n_episodes = min(stream.scores.n_episodes for stream in streams)
    return CrossFit(np.array(above), peaks, np.array(differences), n_groups, n_episodes, seed)


def held_out_scores(stream: Stream, sides: Sides) -> Matrix:
    """(R,) accuracy in every split: the site that is best on either half, scored on the other half."""
    return np.concatenate([_held_out(stream, part) for part in _in_parts(sides)])


def _held_out(stream: Stream, sides: Sides) -> Matrix:
    halves = [(sides == side).T.astype(np.float64) for side in (1, -1)]
    sums = [stream.scores.sums @ half for half in halves]
    guides = sums if stream.guide is stream.scores.sums else [stream.guide @ half for half in halves]
    right = _score_of_best(guides[0], sums[1]) + _score_of_best(guides[1], sums[0])
    shares: Matrix = right / (stream.scores.sizes @ (halves[0] + halves[1]))
    return shares


def _score_of_best(guide: Matrix, sums: Matrix) -> Matrix:
    """(R,) of (S, R): mean of `sums` over the sites at which `guide` is largest."""
    best = guide >= guide.max(axis=0) - _EQUAL
    mean: Matrix = np.einsum("sr,sr->r", best, sums) / best.sum(axis=0)
    return mean


def _in_parts(sides: Sides) -> Iterator[Sides]:
    for start in range(0, len(sides), _AT_ONCE):
        yield sides[start : start + _AT_ONCE]


def smoothing(layers: ArrayLike, iterations: ArrayLike) -> Matrix:
    """(S, S) weights ¼, ½, ¼ along layers times those along iterations, of sites at (S,) places.

    At an edge, or beside a site that was not captured, the site stands for its missing neighbour.
    """
    places = [np.unique(np.asarray(axis), return_inverse=True)[1] for axis in (layers, iterations)]
    row_at = {place: row for row, place in enumerate(zip(*(axis.tolist() for axis in places), strict=True))}
    weights: Matrix = np.eye(len(row_at))
    for step in ((1, 0), (0, 1)):
        along = np.zeros_like(weights)
        for (layer, iteration), row in row_at.items():
            along[row, row] += 0.5
            for way in (1, -1):
                beside = (layer + way * step[0], iteration + way * step[1])
                along[row, row_at.get(beside, row)] += 0.25
        weights = along @ weights
    return weights


@lru_cache(maxsize=4)  # the same for all streams and views of a category
def _splits(n_groups: int, seed: int) -> tuple[Sides, Sides]:
    """Splits of all groups, (REPEATS, G), and of both halves of each halving, one after another."""
    generator = np.random.default_rng(seed)
    whole = _halve(generator, np.ones((REPEATS, n_groups), np.bool_))
    halvings = _halve(generator, np.ones((HALVINGS, n_groups), np.bool_))
    halves = np.stack([halvings == 1, halvings == -1], axis=1).reshape(-1, n_groups)
    parts = _halve(generator, np.repeat(halves, REPEATS_OF_HALF, axis=0))
    whole.setflags(write=False)
    parts.setflags(write=False)
    return whole, parts


def _halve(generator: np.random.Generator, taking_part: NDArray[np.bool_]) -> Sides:
    """(R, G) random halves of the groups that take part; of an odd number the second half has one more."""
    drawn = np.where(taking_part, generator.random(taking_part.shape), np.inf)
    rank = drawn.argsort(axis=1).argsort(axis=1)
    first = rank < taking_part.sum(axis=1, keepdims=True) // 2
    return np.where(taking_part, np.where(first, 1, -1), 0).astype(np.int8)


def _check(streams: Sequence[Stream]) -> int:
    counts = sorted({stream.scores.n_groups for stream in streams})
    if len(counts) != 1:
        raise UsageError(f"streams on {counts} groups; expected one or more streams on the same groups")
    if counts[0] < FEWEST_GROUPS:
        raise TooFewGroupsError(
            f"{counts[0]} independent groups of items; expected at least {FEWEST_GROUPS}, so that either half of "
            "them can choose a site and score it. Extract more items of this category."
        )
    for stream in streams:
        if not (np.isfinite(stream.scores.sums).all() and (stream.scores.sizes > 0).all()):
            raise UsageError(
                "sums hold NaN, or a group has no episode; expected finite sums of groups with episodes"
            )
    return counts[0]
