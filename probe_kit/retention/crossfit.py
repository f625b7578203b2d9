"""Scores of the best site, without the luck of having been chosen."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.train.folds import assign_folds

Matrix = NDArray[np.float64]

REPEATS = 10
FOLDS = 5


@dataclass(frozen=True)
class GroupScores:
    """Correct decisions per group of items, the unit of every resampling here.

    sums: (S, G) correctly decided episodes per site and group. sizes: (G,) episodes per group.
    """

    sums: Matrix
    sizes: Matrix

    @classmethod
    def of(cls, correct: NDArray[np.bool_], groups: ArrayLike) -> "GroupScores":
        """From (S, E) correctness and (E,) groups."""
        names, group_of = np.unique(np.asarray(groups), return_inverse=True)
        sums = np.zeros((len(correct), names.size))
        np.add.at(sums.T, group_of, correct.T.astype(np.float64))
        return cls(sums, np.bincount(group_of).astype(np.float64))

    def only(self, sites: NDArray[np.intp]) -> "GroupScores":
        """The same for some of the sites."""
        return GroupScores(self.sums[sites], self.sizes)


@dataclass(frozen=True)
class Crossfit:
    """Mean scores above chance of the chosen sites, on episodes that had no part in choosing.

    covariance: (2, 2) of the (expert, backbone) means, groups as the unit. held_out: (repeats, 2, G) correct
    decisions of the sites chosen for (expert, backbone) per group.
    """

    expert: float
    backbone: float
    covariance: Matrix
    held_out: Matrix


def crossfit(backbone: GroupScores, expert: GroupScores, chance: float, seed: int) -> Crossfit:
    """Choose each stream's best site on four fifths of the groups, score both on the rest, ten times over.

    The means are averages over the ten. The covariance is that of a single one: within it, from group to group,
    plus between them, from choosing other sites. The average of ten looks more precise than choosing is
    (`benchmarks/retention_null.py` has the coverage of both).
    """
    n_groups, n_episodes = backbone.sizes.size, backbone.sizes.sum()
    means, within, held_out = np.zeros((REPEATS, 2)), np.zeros((2, 2)), np.zeros((REPEATS, 2, n_groups))
    for repeat in range(REPEATS):
        fold_of = assign_folds(np.zeros(n_groups), np.arange(n_groups), FOLDS, seed + repeat)
        sums = held_out[repeat] = np.array([_held_out(expert, fold_of), _held_out(backbone, fold_of)])
        means[repeat] = sums.sum(axis=1) / n_episodes
        rest = sums - means[repeat][:, None] * backbone.sizes
        within += rest @ rest.T * n_groups / (n_groups - 1) / n_episodes**2 / REPEATS
    above = means.mean(axis=0) - chance
    return Crossfit(float(above[0]), float(above[1]), within + np.cov(means.T), held_out)


def _held_out(scores: GroupScores, fold_of: NDArray[np.intp]) -> Matrix:
    """(G,) correct decisions of the site chosen on the other folds' groups."""
    total = scores.sums.sum(axis=1)
    held_out = np.empty(scores.sizes.size)
    for fold in range(FOLDS):
        test = fold_of == fold
        best = np.argmax(total - scores.sums[:, test].sum(axis=1))
        held_out[test] = scores.sums[best, test]
    return held_out
