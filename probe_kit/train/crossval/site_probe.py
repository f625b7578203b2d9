"""One site's probe: nested, grouped cross-validation for the labels and all their permutations at once."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import NonFiniteActivationError
from probe_kit.statistics.folds import Fold
from probe_kit.train.crossval.batched_folds import cross_validate_together, is_small
from probe_kit.train.crossval.joint import can_be_joint, cross_validate_jointly
from probe_kit.train.crossval.joint_design import JointSite
from probe_kit.train.crossval.metrics import correctness, log_loss, log_losses
from probe_kit.train.crossval.nested_folds import (
    STRENGTHS,
    FittedFold,
    InnerQuality,
    Matrix,
    NestedFold,
    nested_folds,
    select_c,
)
from probe_kit.train.data.samples import Samples
from probe_kit.train.solver.backend import to_numpy
from probe_kit.train.solver.logistic import LogisticSolver
from probe_kit.train.solver.projection import Projection

__all__ = [
    "STRENGTHS",
    "FittedFold",
    "NestedFold",
    "SiteProbe",
    "check_non_finite",
    "cross_validate",
    "nested_folds",
    "probe_site",
]


@dataclass(frozen=True)
class SiteProbe:
    """What is kept of a site's probe.

    decisions: (E,) out-of-fold decision values; positive means label 1.
    strengths: (F,) the C chosen in each outer fold.
    weights, intercepts: (F, D) float32 and (F,) of each outer fold's probe, on raw features.
    spreads: (F,) deviation of the fold's training samples along its weights, in units of the features.
    null: (P,) accuracies under the label permutations.
    inner: (F, E) float32 log-likelihood of each episode's label in the inner folds of each outer fold, at its C; 0
    for the episodes that the outer fold tests.
    """

    decisions: Matrix
    strengths: Matrix
    weights: NDArray[np.float32]
    intercepts: Matrix
    spreads: Matrix
    null: Matrix
    inner: NDArray[np.float32]


def probe_site(
    samples: Samples,
    labels: NDArray[np.bool_],
    permuted_labels: NDArray[np.bool_],
    folds: list[NestedFold],
) -> SiteProbe:
    """Probe the samples of E episodes for (E,) labels, and again for every column of (E, P) label permutations.

    Raises ProbeNotConvergedError, and NonFiniteActivationError for NaN or infinity.
    """
    check_non_finite(samples)
    columns = np.column_stack([labels, permuted_labels])
    fitted = cross_validate(samples, columns, folds)
    decisions = _out_of_fold(fitted, folds)
    return SiteProbe(
        decisions=decisions[:, 0],
        strengths=np.array([fold.strengths[0] for fold in fitted]),
        weights=np.stack([fold.weights for fold in fitted]).astype(np.float32),
        intercepts=np.array([fold.intercept for fold in fitted]),
        spreads=np.array([fold.spread for fold in fitted]),
        null=correctness(decisions, columns)[:, 1:].mean(axis=0),
        inner=np.stack([fold.inner.first for fold in fitted]).astype(np.float32),
    )


def check_non_finite(samples: Samples) -> None:
    """Raise NonFiniteActivationError, naming the first broken episode by its number, if there is any."""
    broken = samples.broken()
    if broken.size:
        raise NonFiniteActivationError(
            f"{broken.size} of {len(samples.counts)} episodes hold NaN or infinity, first number {broken[0]}, "
            "from 0 on; expected finite features. Leave these episodes out, or extract them again."
        )


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
    """For each label column the C of the grid with the lowest held-out log-loss, and the quality there.

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
    chosen = select_c(loss)
    return STRENGTHS[chosen], InnerQuality.of(-loss, -by_episode, chosen)


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


def _out_of_fold(fitted: list[FittedFold], folds: list[NestedFold]) -> Matrix:
    """(E, K) decisions, each episode's from the fold that tests it."""
    tested = np.concatenate([fold.outer.test for fold in folds])
    decisions: Matrix = np.concatenate([fold.decisions for fold in fitted])[np.argsort(tested)]
    return decisions
