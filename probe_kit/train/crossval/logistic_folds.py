"""Nested logistic probes of a site: C by the log-loss of the inner folds, for every column of labels at once.

Three ways lead to the same optimum. Every fold is solved by itself; small problems of all folds are stacked; with
many samples, training sets, permutations and C share the products with them.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import batched
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit.errors import TooFewGroupsError
from probe_kit.statistics.folds import Fold
from probe_kit.train.crossval.joint_objective import JointProblems, JointSite, solve
from probe_kit.train.crossval.nested_folds import STRENGTHS, FittedFold, InnerQuality, NestedFold, select_c
from probe_kit.train.crossval.task_scores import log_loss, log_losses
from probe_kit.train.samples import Samples
from probe_kit.train.solver.arrays import Array, array_namespace, to_device_of, to_numpy
from probe_kit.train.solver.design_matrix import IN_MEMORY, Projection, StackedDesign
from probe_kit.train.solver.logistic import LogisticSolver, check_single_class

# -- every fold by itself -----------------------------------------------------------------------------------------


def cross_validate(samples: Samples, labels: NDArray[np.bool_], folds: list[NestedFold]) -> list[FittedFold]:
    """Return the probes of every outer fold, each column of (E, K) labels on its own.

    Problems that `can_be_joint` names, such as wide tokens with few columns, are solved for all training sets
    together where these have the same features. Small problems are also solved together.

    Raises:
        ProbeNotConvergedError: If a probe stops before its optimum.
        TooFewGroupsError: For a training set with a single class.
    """
    if can_be_joint(samples, labels.shape[1]) and (site := JointSite.of(samples, folds)).alike:
        return cross_validate_jointly(site, samples, labels, folds)
    if is_small(samples, labels):
        return cross_validate_together(samples, labels, folds)
    return [_fit_fold(samples, labels, f.outer, *choose_strengths(samples, labels, f.inner)) for f in folds]


class _FoldProblem(NamedTuple):
    """The training set of one fold.

    Attributes:
        coordinates: Its n samples in R coordinates.
        solver: Solver on these samples.
        held_out: (m, R) coordinates of the test episodes.
        labels: (n, K) labels by sample.
    """

    coordinates: Projection
    solver: LogisticSolver
    held_out: Array
    labels: NDArray[np.bool_]

    @classmethod
    def of(cls, samples: Samples, labels: NDArray[np.bool_], fold: Fold) -> "_FoldProblem":
        train = samples.of(fold.train)
        coordinates = Projection.fit(train.features)
        held_out = coordinates(samples.of(fold.test).means)
        return cls(coordinates, LogisticSolver(coordinates.train), held_out, train.repeat(labels[fold.train]))


def choose_strengths(
    samples: Samples, labels: NDArray[np.bool_], folds: list[Fold]
) -> tuple[Matrix, InnerQuality]:
    """Return for each label column the C with the lowest held-out log-loss, and the quality there.

    On ties it is the smaller C.
    """
    loss = np.zeros((STRENGTHS.size, labels.shape[1]))
    by_episode = np.zeros((STRENGTHS.size, len(labels)))
    for fold in folds:
        training, truth = _FoldProblem.of(samples, labels, fold), labels[fold.test]
        for step, weights in enumerate(training.solver.path(training.labels, STRENGTHS)):
            decisions = to_numpy(training.held_out @ weights)
            loss[step] += log_loss(decisions, truth) * fold.test.size
            by_episode[step, fold.test] = log_losses(decisions[:, 0], truth[:, 0])
    best = select_c(loss)
    return STRENGTHS[best], InnerQuality.of(-loss, -by_episode, best)


def _fit_fold(
    samples: Samples, labels: NDArray[np.bool_], fold: Fold, strengths: Matrix, inner: InnerQuality
) -> FittedFold:
    training = _FoldProblem.of(samples, labels, fold)
    decisions = np.empty((fold.test.size, labels.shape[1]))
    for strength in np.unique(strengths):
        columns = np.flatnonzero(strengths == strength)
        (weights,) = training.solver.path(training.labels[:, columns], np.array([strength]))
        decisions[:, columns] = to_numpy(training.held_out @ weights)
        if columns[0] == 0:
            first = weights
    return FittedFold.of(training.coordinates, first, decisions, strengths, inner)


# -- small problems, stacked --------------------------------------------------------------------------------------

STACKED_COLUMNS, SMALL_HESSIAN = 32, 2**20
"""Label columns, and multiplications of each (N · R²), up to which whole Hessians cost less than the many small
products of conjugate gradients."""

COLUMNS_AT_ONCE = 128
"""Label columns of all folds together: more of them do not fit into a processor's cache."""


def is_small(samples: Samples, labels: NDArray[np.bool_]) -> bool:
    """Whether the problems of (E, K) labels are few and small enough to be solved together."""
    count, width = samples.features.shape
    return samples.pools and labels.shape[1] <= STACKED_COLUMNS and count * min(count, width) ** 2 <= SMALL_HESSIAN


def cross_validate_together(
    samples: Samples, labels: NDArray[np.bool_], folds: list[NestedFold]
) -> list[FittedFold]:
    """Return the probes of every outer fold, each column of (E, K) labels on its own.

    Raises:
        ProbeNotConvergedError: If a probe stops before its optimum.
        TooFewGroupsError: For a training set with a single class.
    """
    inner = _at_once([fold for nested in folds for fold in nested.inner], labels)
    parts = [_Together.of(samples, labels, some).losses() for some in inner]
    loss, by_episode = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
    begins = np.cumsum([0, *(len(nested.inner) for nested in folds[:-1])])
    loss, by_episode = (np.add.reduceat(part, begins, axis=1) for part in (loss, by_episode))
    best = select_c(loss)
    choices = [
        (STRENGTHS[best[number]], InnerQuality.of(-loss[:, number], -by_episode[:, number], best[number]))
        for number in range(len(folds))
    ]
    outer = zip(_at_once([fold.outer for fold in folds], labels), _at_once(choices, labels), strict=True)
    return [
        fitted
        for some, some_choices in outer
        for fitted in _Together.of(samples, labels, some).fitted(some_choices)
    ]


def _at_once[T](folds: Iterable[T], labels: NDArray[np.bool_]) -> Iterator[tuple[T, ...]]:
    """Yield parts of `folds`, or of their data, whose problems fit into a processor's cache."""
    return batched(folds, max(1, COLUMNS_AT_ONCE // labels.shape[1]))


@dataclass(frozen=True)
class _Together:
    """The training sets of F folds, and K label columns for each.

    Column f · K + k of the solver is of fold f.

    Attributes:
        labels: (E, K) labels of all episodes.
        coordinates: Training samples of every fold.
        held_out: Test episodes of every fold, in its coordinates.
        signs: (N, F · K) labels −1/+1, 0 where a fold has fewer than N samples.
    """

    folds: Sequence[Fold]
    labels: NDArray[np.bool_]
    coordinates: list[Projection]
    held_out: list[Array]
    solver: LogisticSolver
    signs: Array

    @classmethod
    def of(cls, samples: Samples, labels: NDArray[np.bool_], folds: Sequence[Fold]) -> "_Together":
        coordinates = [Projection.fit(samples.of(fold.train).features) for fold in folds]
        held_out = [
            projection(samples.of(fold.test).means) for projection, fold in zip(coordinates, folds, strict=True)
        ]
        design = StackedDesign.of_folds([projection.train for projection in coordinates], labels.shape[1])
        signs = np.zeros((design.shape[0], len(folds), labels.shape[1]))
        for number, fold in enumerate(folds):
            check_single_class(labels[fold.train])
            signs[: fold.train.size, number] = 2.0 * labels[fold.train] - 1.0
        columns = to_device_of(design.samples, signs.reshape(len(signs), -1))
        return cls(folds, labels, coordinates, held_out, LogisticSolver(design), columns)

    def losses(self) -> tuple[Matrix, Matrix]:
        """Return the log-losses along the grid of C: of all label columns, and of the first one by episode.

        Returns:
            (C, F, K) log-losses of the test episodes, summed; (C, F, E) log-losses of the first column, which are
            0 outside of a fold's test episodes.
        """
        loss = np.empty((STRENGTHS.size, len(self.folds), self.labels.shape[1]))
        by_episode = np.zeros((STRENGTHS.size, len(self.folds), len(self.labels)))
        for step, weights in enumerate(self.solver.path_of_signs(self.signs, STRENGTHS)):
            parts = zip(self.held_out, self._of_folds(weights), self.folds, strict=True)
            for number, (held_out, fold_weights, fold) in enumerate(parts):
                decisions, truth = to_numpy(held_out @ fold_weights), self.labels[fold.test]
                loss[step, number] = log_loss(decisions, truth) * fold.test.size
                by_episode[step, number, fold.test] = log_losses(decisions[:, 0], truth[:, 0])
        return loss, by_episode

    def fitted(self, choices: Sequence[tuple[Matrix, InnerQuality]]) -> list[FittedFold]:
        """Return the probes of every fold with its choice: (K,) strengths, and the quality that chose them."""
        strengths = np.array([strength for strength, _ in choices])
        of_columns = to_device_of(self.signs, strengths.reshape(-1))
        (weights,) = self.solver.path_of_signs(self.signs, [of_columns])
        return [
            FittedFold.of(coordinates, fold_weights, to_numpy(held_out @ fold_weights), *choice)
            for coordinates, fold_weights, held_out, choice in zip(
                self.coordinates, self._of_folds(weights), self.held_out, choices, strict=True
            )
        ]

    def _of_folds(self, weights: Array) -> Iterator[Array]:
        """Yield the weights (R, K) of every fold, without the padding."""
        count = self.labels.shape[1]
        for number, coordinates in enumerate(self.coordinates):
            fold_weights = weights[:, number * count : (number + 1) * count]
            rank = coordinates.train.shape[1]
            yield array_namespace(fold_weights).concatenate([fold_weights[: rank - 1], fold_weights[-1:]])


# -- many samples, whose products are shared ----------------------------------------------------------------------

COLUMN_MEMORY = 2**29
"""Bytes that problems solved at once may take, beyond the samples and the arrays made of them once."""

SHARED_COLUMNS, FEATURES_PER_COLUMN = 10, 50
"""Label columns up to which sharing pays, and features for one more. Axes of a training set's own cost as much as
many columns; each column then costs half, as products pass over its own samples only, and never over axes."""

LEAST_WIDTH = 96
"""Features below which the training sets' own axes cost next to nothing, and sharing products saves nothing."""


def can_be_joint(samples: Samples, columns: int) -> bool:
    """Whether a site's tokens are so many, and so wide, that its training sets should be solved together.

    They always are where inner training sets, three fifths of the tokens, are too large to be turned to axes of
    their own once. They never are on a device, where it was not tried.
    """
    count, width = samples.features.shape
    if samples.pools or not isinstance(samples.means, np.ndarray) or width < LEAST_WIDTH or count < width:
        return False
    few = columns <= SHARED_COLUMNS + width // FEATURES_PER_COLUMN
    return few or 3 * count // 5 * width * 8 > IN_MEMORY


def cross_validate_jointly(
    site: JointSite, samples: Samples, labels: NDArray[np.bool_], folds: Sequence[NestedFold]
) -> list[FittedFold]:
    """Return the probes of every outer fold, each column of (E, P) labels on its own.

    As many columns are solved at once as memory allows. Every C starts from zero. With the solution of the
    previous C as a start, problems took nearly as many products, which were a seventh as wide and so half as fast.

    Raises:
        ProbeNotConvergedError: If a probe stops before its optimum.
        TooFewGroupsError: For a training set with a single class.
    """
    share = site.sets.member @ labels / site.sets.member.sum(axis=1)[:, None]
    if ((share == 0) | (share == 1)).any():
        raise TooFewGroupsError("all training samples have the same label; a probe needs both classes")
    step = labels_at_once(site, folds)
    parts = [
        _SharedColumns(site, samples, labels[:, first : first + step], folds).fitted()
        for first in range(0, labels.shape[1], step)
    ]
    return [_join_parts(fold) for fold in zip(*parts, strict=True)]


def labels_at_once(site: JointSite, folds: Sequence[NestedFold]) -> int:
    """Return the number of label columns whose problems, with all C, fit into COLUMN_MEMORY; at least one."""
    return max(1, _times_at_once(site, folds) // STRENGTHS.size)


def _times_at_once(site: JointSite, folds: Sequence[NestedFold]) -> int:
    """Return how often the problems of all inner folds fit into COLUMN_MEMORY; at least once.

    A problem takes 12 bytes per sample: three float32 vectors of its curvatures while a step is found. It takes
    128 bytes per weight: the solver's rows of weights, directions and products, counted generously as 16 float64.
    """
    count, width = site.features.shape
    problems = sum(len(fold.inner) for fold in folds)
    return max(1, COLUMN_MEMORY // (problems * (12 * count + 128 * (width + 1))))


@dataclass(frozen=True)
class _SharedColumns:
    """The label columns (E, L), on all training sets of a site."""

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
        """Return the chosen C, weights to start from, and the inner quality of every outer fold.

        The weights are the mean of the inner folds' weights.

        Returns:
            Position (F, L) of the chosen C by outer fold and column; weights (C, F, L, D + 1) to start from; and
            the quality of every outer fold.
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
    """Return raw weights, intercept and spread of `some` problems, by their outer fold."""
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


def _join_parts(parts: Sequence[FittedFold]) -> FittedFold:
    """Return one outer fold's probes, found in parts of the columns."""
    decisions = np.concatenate([part.decisions for part in parts], axis=1)
    strengths = np.concatenate([part.strengths for part in parts])
    total = np.concatenate([part.inner.total for part in parts])
    first = parts[0]
    inner = InnerQuality(total, first.inner.first)
    return FittedFold(decisions, strengths, first.weights, first.intercept, first.spread, inner)
