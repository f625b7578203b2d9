"""Nested logistic probes of a site: C by the log-loss of the inner folds, for every column of labels at once."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import batched

import numpy as np
from numpy.typing import NDArray

from probe_kit.statistics.folds import Fold
from probe_kit.train.crossval.joint import can_be_joint, cross_validate_jointly
from probe_kit.train.crossval.joint_objective import JointSite
from probe_kit.train.crossval.nested_folds import STRENGTHS, FittedFold, InnerQuality, Matrix, NestedFold, select_c
from probe_kit.train.crossval.task_scores import log_loss, log_losses
from probe_kit.train.samples import Samples
from probe_kit.train.solver.arrays import Array, array_namespace, to_device_of, to_numpy
from probe_kit.train.solver.design_matrix import Projection, StackedDesign
from probe_kit.train.solver.logistic import LogisticSolver, check_single_class

FEW_COLUMNS, SMALL_HESSIAN = 32, 2**20
"""Up to so many label columns, each of so many multiplications (N · R²), whole Hessians cost less than the many
small products of conjugate gradients."""

COLUMNS_AT_ONCE = 128
"""Of all folds together: more of them do not fit into a processor's cache."""


def is_small(samples: Samples, labels: NDArray[np.bool_]) -> bool:
    """Whether the problems of (E, K) labels are few and small enough to be solved together."""
    count, width = samples.features.shape
    return samples.pools and labels.shape[1] <= FEW_COLUMNS and count * min(count, width) ** 2 <= SMALL_HESSIAN


def cross_validate_together(
    samples: Samples, labels: NDArray[np.bool_], folds: list[NestedFold]
) -> list[FittedFold]:
    """The probes of every outer fold, each column of (E, K) labels on its own.

    Raises ProbeNotConvergedError, and TooFewGroupsError for a training set with a single class.
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
    """Parts of `folds`, or of what is known of each, whose problems fit into a processor's cache."""
    return batched(folds, max(1, COLUMNS_AT_ONCE // labels.shape[1]))


@dataclass(frozen=True)
class _Together:
    """The training sets of F folds, and K label columns for each: column f · K + k of the solver is of fold f.

    labels: (E, K). signs: (N, F · K), 0 where a fold has fewer than N samples.
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
        """(C, F, K) log-losses of the test episodes, summed, along the grid of C; (C, F, E) the first column's.

        Those by episode are 0 outside of a fold's test episodes.
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
        """(R, K) of every fold, without what was filled up."""
        count = self.labels.shape[1]
        for number, coordinates in enumerate(self.coordinates):
            fold_weights = weights[:, number * count : (number + 1) * count]
            rank = coordinates.train.shape[1]
            yield array_namespace(fold_weights).concatenate([fold_weights[: rank - 1], fold_weights[-1:]])


def cross_validate(samples: Samples, labels: NDArray[np.bool_], folds: list[NestedFold]) -> list[FittedFold]:
    """The probes of every outer fold, each column of (E, K) labels on its own.

    Wide tokens with few columns are solved for all training sets together, where these have the same features, and
    so are small problems.
    Raises ProbeNotConvergedError, and TooFewGroupsError for a training set with a single class.
    """
    if can_be_joint(samples, labels.shape[1]) and (site := JointSite.of(samples, folds)).alike:
        return cross_validate_jointly(site, samples, labels, folds)
    if is_small(samples, labels):
        return cross_validate_together(samples, labels, folds)
    return [_fit_fold(samples, labels, f.outer, *choose_strengths(samples, labels, f.inner)) for f in folds]


def choose_strengths(
    samples: Samples, labels: NDArray[np.bool_], folds: list[Fold]
) -> tuple[Matrix, InnerQuality]:
    """Return for each label column the C with the lowest held-out log-loss, and the quality there.

    The smaller C on ties.
    """
    loss = np.zeros((STRENGTHS.size, labels.shape[1]))
    by_episode = np.zeros((STRENGTHS.size, len(labels)))
    for fold in folds:
        train = samples.of(fold.train)
        coordinates = Projection.fit(train.features)
        held_out, truth = coordinates(samples.of(fold.test).means), labels[fold.test]
        solver = LogisticSolver(coordinates.train)
        for step, weights in enumerate(solver.path(train.repeat(labels[fold.train]), STRENGTHS)):
            decisions = to_numpy(held_out @ weights)
            loss[step] += log_loss(decisions, truth) * fold.test.size
            by_episode[step, fold.test] = log_losses(decisions[:, 0], truth[:, 0])
    best = select_c(loss)
    return STRENGTHS[best], InnerQuality.of(-loss, -by_episode, best)


def _fit_fold(
    samples: Samples, labels: NDArray[np.bool_], fold: Fold, strengths: Matrix, inner: InnerQuality
) -> FittedFold:
    train = samples.of(fold.train)
    coordinates = Projection.fit(train.features)
    solver = LogisticSolver(coordinates.train)
    held_out, training_labels = coordinates(samples.of(fold.test).means), train.repeat(labels[fold.train])
    decisions = np.empty((fold.test.size, labels.shape[1]))
    for strength in np.unique(strengths):
        columns = np.flatnonzero(strengths == strength)
        (weights,) = solver.path(training_labels[:, columns], np.array([strength]))
        decisions[:, columns] = to_numpy(held_out @ weights)
        if columns[0] == 0:
            first = weights
    return FittedFold.of(coordinates, first, decisions, strengths, inner)
