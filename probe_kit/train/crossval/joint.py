"""Nested cross-validation of a site with many samples: training sets, permutations and C share products.

Every C starts from nothing: with the one before as a start, problems took nearly as many products, which were a
seventh as wide and so half as fast.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import batched

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import TooFewGroupsError
from probe_kit.train.crossval.joint_objective import JointProblems, JointSite, solve
from probe_kit.train.crossval.nested_folds import STRENGTHS, FittedFold, InnerQuality, Matrix, NestedFold, select_c
from probe_kit.train.crossval.task_scores import log_loss, log_losses
from probe_kit.train.samples import Samples
from probe_kit.train.solver.arrays import Array, array_namespace, to_numpy
from probe_kit.train.solver.design_matrix import IN_MEMORY

COLUMN_MEMORY = 2**29
"""Bytes that problems solved at once may take, beyond the samples and what is made of them once."""

FEW_COLUMNS, FEATURES_PER_COLUMN = 10, 50
"""Label columns up to which sharing pays, and features for one more. Axes of a training set's own cost as much as
many columns; each column then costs half, as products pass over its own samples only, and never over axes."""

LEAST_WIDTH = 96
"""Features below which the training sets' own axes cost next to nothing, and sharing products saves nothing."""


def can_be_joint(samples: Samples, columns: int) -> bool:
    """Whether a site's tokens are so many, and so wide, that its training sets should be solved together.

    Always those whose inner training sets, three fifths of the tokens, are too large to be turned to axes of their
    own once. Never those on a device: there it was not tried.
    """
    count, width = samples.features.shape
    if samples.pools or not isinstance(samples.means, np.ndarray) or width < LEAST_WIDTH or count < width:
        return False
    few = columns <= FEW_COLUMNS + width // FEATURES_PER_COLUMN
    return few or 3 * count // 5 * width * 8 > IN_MEMORY


def cross_validate_jointly(
    site: JointSite, samples: Samples, labels: NDArray[np.bool_], folds: Sequence[NestedFold]
) -> list[FittedFold]:
    """The probes of every outer fold, each column of (E, P) labels on its own, as many at once as memory allows.

    Raises ProbeNotConvergedError, and TooFewGroupsError for a training set with a single class.
    """
    share = site.sets.member @ labels / site.sets.member.sum(axis=1)[:, None]
    if ((share == 0) | (share == 1)).any():
        raise TooFewGroupsError("all training samples have the same label; a probe needs both classes")
    step = labels_at_once(site, folds)
    parts = [
        _Columns(site, samples, labels[:, first : first + step], folds).fitted()
        for first in range(0, labels.shape[1], step)
    ]
    return [_joined(fold) for fold in zip(*parts, strict=True)]


def labels_at_once(site: JointSite, folds: Sequence[NestedFold]) -> int:
    """Columns of labels whose problems, with all C, fit into COLUMN_MEMORY; at least one."""
    return max(1, _times_at_once(site, folds) // STRENGTHS.size)


def _times_at_once(site: JointSite, folds: Sequence[NestedFold]) -> int:
    """Return how often the problems of all inner folds fit into COLUMN_MEMORY; at least once.

    A problem takes three curvatures of every sample in float32 while a step is found, and some 16 rows of weights.
    """
    count, width = site.features.shape
    problems = sum(len(fold.inner) for fold in folds)
    return max(1, COLUMN_MEMORY // (problems * (12 * count + 128 * (width + 1))))


@dataclass(frozen=True)
class _Columns:
    """Some columns of labels, (E, L), on all training sets of a site."""

    site: JointSite
    samples: Samples
    labels: NDArray[np.bool_]
    folds: Sequence[NestedFold]

    def fitted(self) -> list[FittedFold]:
        best, starts, quality = self._select_strengths()
        inner = len(self.site.sets.outer) - len(best)
        fold, column = (part.ravel() for part in np.indices(best.shape))
        problems = self._problems(inner + fold, column, STRENGTHS[best].ravel())
        weights = solve(problems, starts[best.ravel(), fold, column])
        decisions = to_numpy(problems.decisions(weights, self.samples.means)).reshape(*best.shape, -1)
        first = _raw_probes(problems, weights, fold, np.flatnonzero(column == 0))
        return [
            FittedFold(
                decisions[number][:, nested.outer.test].T,
                STRENGTHS[best[number]],
                *first[number],
                quality[number],
            )
            for number, nested in enumerate(self.folds)
        ]

    def _select_strengths(self) -> tuple[NDArray[np.intp], Array, list[InnerQuality]]:
        """(F, L) position of the chosen C by outer fold and column; (C, F, L, D + 1) weights to start from.

        The weights are the mean of the inner folds'. Returns also the inner quality of every outer fold.
        """
        sets = [(number, inner) for number, nested in enumerate(self.folds) for inner in nested.inner]
        of_fold = np.array([number for number, _ in sets])
        loss = np.zeros((STRENGTHS.size, len(self.folds), self.labels.shape[1]))
        by_episode = np.zeros((STRENGTHS.size, len(self.folds), len(self.labels)))
        starts = []
        for step, (weights, of_sets) in enumerate(self._along_grid(len(sets))):
            for (number, inner), decisions in zip(sets, of_sets, strict=True):
                decided, truth = decisions[:, inner.test].T, self.labels[inner.test]
                loss[step, number] += log_loss(decided, truth) * inner.test.size
                by_episode[step, number, inner.test] = log_losses(decided[:, 0], truth[:, 0])
            starts.append([weights[of_fold == number].mean(axis=0) for number in range(len(self.folds))])
        xp = array_namespace(self.site.mean)
        best = select_c(loss)
        quality = [
            InnerQuality.of(-loss[:, number], -by_episode[:, number], best[number])
            for number in range(len(self.folds))
        ]
        return best, xp.stack([xp.stack(by_fold) for by_fold in starts]), quality

    def _along_grid(self, sets: int) -> Iterator[tuple[Array, Matrix]]:
        """Yield for each C weights (S, L, D + 1) and decisions (S, L, E) of all inner folds, many at once."""
        xp, columns = array_namespace(self.site.mean), self.labels.shape[1]
        width = len(self.site.mean) + 1
        for some in batched(STRENGTHS, _times_at_once(self.site, self.folds)):
            grid, set_of, column = (part.ravel() for part in np.indices((len(some), sets, columns)))
            problems = self._problems(set_of, column, np.array(some)[grid])
            start = xp.zeros((len(problems), width), dtype=xp.float64, device=self.site.mean.device)
            weights = solve(problems, start)
            decided = to_numpy(problems.decisions(weights, self.samples.means))
            shape = len(some), sets, columns, -1
            yield from zip(weights.reshape(shape), decided.reshape(shape), strict=True)

    def _problems(
        self, sets: NDArray[np.intp], columns: NDArray[np.intp], strength: NDArray[np.float64]
    ) -> JointProblems:
        signs = np.where(self.labels, 1, -1).astype(np.int8).T
        return JointProblems(self.site, sets, signs[columns], strength)


def _raw_probes(
    problems: JointProblems, weights: Array, fold: NDArray[np.intp], some: NDArray[np.intp]
) -> dict[int, tuple[Matrix, float, float]]:
    """Raw weights, intercept and spread of `some` problems, by their outer fold."""
    if not some.size:
        return {}
    subset = JointProblems(problems.site, problems.set_of[some], problems.signs[some], problems.strength[some])
    parts = (*subset.raw(weights[some]), subset.deviations(weights[some]))
    raw, intercepts, along = (to_numpy(part) for part in parts)
    length = np.linalg.norm(raw, axis=1)
    spread = np.where(length > 0, along / np.where(length > 0, length, 1.0), 0.0)
    return {
        int(number): (raw[position], float(intercepts[position]), float(spread[position]))
        for position, number in enumerate(fold[some])
    }


def _joined(parts: Sequence[FittedFold]) -> FittedFold:
    """One outer fold's probes, found in parts of the columns."""
    decisions = np.concatenate([part.decisions for part in parts], axis=1)
    strengths = np.concatenate([part.strengths for part in parts])
    total = np.concatenate([part.inner.total for part in parts])
    first = parts[0]
    inner = InnerQuality(total, first.inner.first)
    return FittedFold(decisions, strengths, first.weights, first.intercept, first.spread, inner)
