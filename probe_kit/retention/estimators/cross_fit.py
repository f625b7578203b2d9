"""Scores of the best site, without the luck of having been chosen."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.statistics.bootstrap import reach

Matrix = NDArray[np.float64]
Sides = NDArray[np.int8]
"""(R, G): which half a group falls in, in each of R splits: 1 or −1; 0 for a group that takes no part."""

REPEATS = 100
HALVINGS = 100
REPEATS_OF_HALF = 10


@dataclass(frozen=True)
class GroupScores:
    """Correct decisions per group of items, the unit of every resampling here.

    sums: (S, G) correctly decided episodes per site and group. sizes: (G,) episodes per group. guide: (S, G) what
    sites are chosen by, `sums` themselves by default.
    """

    sums: Matrix
    sizes: Matrix
    guide: Matrix | None = None

    @classmethod
    def of(cls, correct: NDArray[np.bool_], groups: ArrayLike) -> "GroupScores":
        """From (S, E) correctness and (E,) groups."""
        names, group_of = np.unique(np.asarray(groups), return_inverse=True)
        sums = np.zeros((len(correct), names.size))
        np.add.at(sums.T, group_of, correct.T.astype(np.float64))
        return cls(sums, np.bincount(group_of).astype(np.float64))

    def guided(self, weights: Matrix) -> "GroupScores":
        """The same, chosen by `weights` (S, S) of the sums."""
        return GroupScores(self.sums, self.sizes, weights @ self.sums)

    def only(self, sites: NDArray[np.intp]) -> "GroupScores":
        """The same for some of the sites."""
        return GroupScores(self.sums[sites], self.sizes)


@dataclass(frozen=True)
class Crossfit:
    """Mean scores above chance of the chosen sites, on episodes that had no part in choosing.

    covariance: (2, 2) of the (expert, backbone) means, groups as the unit. held_out: (2, G) correct decisions of
    the chosen sites for (expert, backbone) per group, averaged over the splits. sizes: (G,) episodes per group.
    """

    expert: float
    backbone: float
    covariance: Matrix
    held_out: Matrix
    sizes: Matrix

    @property
    def scoring(self) -> Matrix:
        """(2, 2) part of the covariance that is there with the chosen sites given: from group to group."""
        return scoring_covariance(self.held_out, self.sizes)


def scoring_covariance(held_out: Matrix, sizes: Matrix) -> Matrix:
    """(2, 2) of two shares, from their (2, G) correct decisions per group and (G,) sizes; groups vary."""
    shares = held_out.sum(axis=1, keepdims=True) / sizes.sum()
    rest = held_out - shares * sizes
    covariance: Matrix = rest @ rest.T * sizes.size / (sizes.size - 1) / sizes.sum() ** 2
    return covariance


def add_unobserved_variance(covariance: Matrix, held_out: Matrix, sizes: Matrix) -> Matrix:
    """`covariance` of two shares, neither of them known better than what groups allow that nobody has seen.

    held_out, sizes: (2, G) correct decisions and (G,) episodes. Where all groups agree the share t of those that
    are otherwise is Beta(1, G), and they may lie at either bound; an interval of a ratio has one spread for both
    directions, that toward the farther bound. The more groups differ the less there is of it, see `reach`.
    """
    groups, shares = sizes.size, held_out.sum(axis=1) / sizes.sum()
    each = (held_out / sizes).T
    part = reach(each) / reach(np.zeros_like(each))
    least = 2 / ((groups + 1) * (groups + 2)) * (part * np.maximum(shares, 1 - shares)) ** 2
    np.fill_diagonal(covariance, np.maximum(covariance.diagonal(), least))
    return covariance


def crossfit(
    backbone: GroupScores, expert: GroupScores, chance: float, seed: int, peak_share: float = 0.0
) -> Crossfit:
    """Choose each stream's best site on one half of the groups, score it on the other, a hundred times over.

    Halves, not five folds: bias is the same, and the spread of the average a third less, because the choices
    made on four fifths of the data are nearly one choice and average nothing out.

    The covariance comes from the same estimate on halves of the data, which share no group: half of what two of
    them differ by is the variance at half the size, and half of that the variance at full size. Choosing again is
    part of it. A bootstrap would count what its copies of a group agree on as signal. A half averages over
    fewer splits than the whole, which errs on the side of width. Where groups agree, or nearly so, there is little
    difference to see, and the variance is at least that of what unseen groups may hold.

    peak_share: weight of the best site on all groups, scored on them too; it has no part in the covariance.
    """
    sizes = backbone.sizes
    splits, splits_of_halves = _splits(sizes.size, seed)
    chosen = np.array([held_out_scores(stream, splits).mean(axis=0) for stream in (expert, backbone)])
    peaks = np.array([stream.sums[stream.sums.sum(axis=1).argmax()] for stream in (expert, backbone)])
    held_out = (1 - peak_share) * chosen + peak_share * peaks
    above = held_out.sum(axis=1) / sizes.sum() - chance
    covariance = _covariance_by_halving((expert, backbone), splits_of_halves)
    covariance = add_unobserved_variance(covariance, held_out, sizes)
    return Crossfit(float(above[0]), float(above[1]), covariance, held_out, sizes)


def random_halves(generator: np.random.Generator, groups: NDArray[np.intp], n_groups: int, count: int) -> Sides:
    """`count` splits of some of `n_groups` groups into two halves, (count, n_groups)."""
    sides = np.zeros((count, n_groups), np.int8)
    for split in sides:
        drawn = generator.permutation(groups)
        split[drawn[: groups.size // 2]] = 1
        split[drawn[groups.size // 2 :]] = -1
    return sides


def held_out_scores(scores: GroupScores, sides: Sides) -> Matrix:
    """(R, G) correct decisions, in every split, of the site that is best on the other half; 0 outside both."""
    guide = scores.sums if scores.guide is None else scores.guide
    best = {side: np.argmax(guide @ (sides == side).T, axis=0)[:, None] for side in (1, -1)}
    chosen = np.where(sides == 1, best[-1], best[1])
    held_out: Matrix = np.take_along_axis(scores.sums, chosen, axis=0) * (sides != 0)
    return held_out


@lru_cache(maxsize=4)  # the same for all numbers of a table that are made of the same groups
def _splits(n_groups: int, seed: int) -> tuple[Sides, Sides]:
    """Splits of all groups, (REPEATS, n_groups), and of both halves of each halving, one after another."""
    generator = np.random.default_rng(seed)
    everyone = np.arange(n_groups)
    whole = random_halves(generator, everyone, n_groups, REPEATS)
    halves = random_halves(generator, everyone, n_groups, HALVINGS)
    of_halves = [
        random_halves(generator, np.flatnonzero(halving == side), n_groups, REPEATS_OF_HALF)
        for halving in halves
        for side in (1, -1)
    ]
    return whole, np.concatenate(of_halves)


def _covariance_by_halving(streams: tuple[GroupScores, GroupScores], sides: Sides) -> Matrix:
    sizes = streams[0].sizes
    shares = np.array([held_out_scores(stream, sides).sum(axis=1) for stream in streams]) / ((sides != 0) @ sizes)
    first, second = np.moveaxis(shares.reshape(2, HALVINGS, 2, REPEATS_OF_HALF).mean(axis=3), 2, 0)
    differences = first - second
    covariance: Matrix = differences @ differences.T / HALVINGS / 4
    return covariance
