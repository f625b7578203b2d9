"""Nested logistic probes of a site: C by the log-loss of the inner folds, for every column of labels at once."""

import numpy as np
from numpy.typing import NDArray

from probe_kit.statistics.folds import Fold
from probe_kit.train.crossval.batched_folds import cross_validate_together, is_small
from probe_kit.train.crossval.joint import can_be_joint, cross_validate_jointly
from probe_kit.train.crossval.joint_design import JointSite
from probe_kit.train.crossval.nested_folds import (
    STRENGTHS,
    FittedFold,
    InnerQuality,
    Matrix,
    NestedFold,
    select_c,
)
from probe_kit.train.crossval.task_scores import log_loss, log_losses
from probe_kit.train.data.samples import Samples
from probe_kit.train.solver.backend import to_numpy
from probe_kit.train.solver.logistic import LogisticSolver
from probe_kit.train.solver.projection import Projection


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
