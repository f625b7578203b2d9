"""One site's probe: nested, grouped cross-validation for the real labels and every relabelling at once."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.errors import NonFiniteActivationError
from probe_kit.statistics.folds import Fold, grouped_folds
from probe_kit.train.arrays import to_numpy
from probe_kit.train.features import Coordinates
from probe_kit.train.samples import Samples
from probe_kit.train.scores import correctness, log_loss
from probe_kit.train.solver import LogisticSolver

Matrix = NDArray[np.float64]

STRENGTHS: Matrix = np.array([1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0])
OUTER_FOLDS = 5
INNER_FOLDS = 4


@dataclass(frozen=True)
class NestedFold:
    """An outer fold, and the inner folds that divide its training side to choose C."""

    outer: Fold
    inner: list[Fold]


def nested_folds(labels: NDArray[np.bool_], groups: ArrayLike, seed: int) -> list[NestedFold]:
    """Outer folds for scoring, each with inner folds for choosing C; all positions refer to the E episodes.

    labels, groups: (E,). Raises TooFewGroupsError.
    """
    group_of = np.asarray(groups)
    return [
        NestedFold(
            outer,
            [
                Fold(outer.train[inner.train], outer.train[inner.test])
                for inner in grouped_folds(labels[outer.train], group_of[outer.train], INNER_FOLDS, seed)
            ],
        )
        for outer in grouped_folds(labels, groups, OUTER_FOLDS, seed)
    ]


@dataclass(frozen=True)
class SiteProbe:
    """What is kept of a site's probe.

    decisions: (E,) out-of-fold decision values; positive means label 1.
    strengths: (F,) the C chosen in each outer fold.
    weights, intercepts: (F, D) float32 and (F,) of each outer fold's probe, on raw features.
    spreads: (F,) deviation of the fold's training samples along its weights, in units of the features.
    null: (P,) accuracies under the relabellings.
    """

    decisions: Matrix
    strengths: Matrix
    weights: NDArray[np.float32]
    intercepts: Matrix
    spreads: Matrix
    null: Matrix


def probe_site(
    samples: Samples,
    labels: NDArray[np.bool_],
    relabellings: NDArray[np.bool_],
    folds: list[NestedFold],
) -> SiteProbe:
    """Probe the samples of E episodes for (E,) labels, and again for every column of (E, P) relabellings.

    Raises ProbeNotConvergedError, and NonFiniteActivationError for NaN or infinity.
    """
    refuse_non_finite(samples)
    columns = np.column_stack([labels, relabellings])
    fitted = cross_validate(samples, columns, folds)
    decisions = _out_of_fold(fitted, folds)
    return SiteProbe(
        decisions=decisions[:, 0],
        strengths=np.array([fold.strengths[0] for fold in fitted]),
        weights=np.stack([fold.weights for fold in fitted]).astype(np.float32),
        intercepts=np.array([fold.intercept for fold in fitted]),
        spreads=np.array([fold.spread for fold in fitted]),
        null=correctness(decisions, columns)[:, 1:].mean(axis=0),
    )


def refuse_non_finite(samples: Samples) -> None:
    """Raise NonFiniteActivationError, naming the first broken episode by its number, if there is any."""
    broken = samples.broken()
    if broken.size:
        raise NonFiniteActivationError(
            f"{broken.size} of {len(samples.counts)} episodes hold NaN or infinity, first number {broken[0]}, "
            "from 0 on; expected finite features. Leave these episodes out, or extract them again."
        )


@dataclass(frozen=True)
class FittedFold:
    """The probes of one outer fold.

    decisions: (n, K) of its test episodes. strengths: (K,) the C chosen for each label column.
    weights (D,), intercept: the first column's probe on raw features, and the deviation (`spread`) of its
    training samples along them.
    """

    decisions: Matrix
    strengths: Matrix
    weights: Matrix
    intercept: float
    spread: float


def cross_validate(samples: Samples, labels: NDArray[np.bool_], folds: list[NestedFold]) -> list[FittedFold]:
    """The probes of every outer fold, each column of (E, K) labels on its own.

    Raises ProbeNotConvergedError.
    """
    return [_fit_fold(samples, labels, f.outer, choose_strengths(samples, labels, f.inner)) for f in folds]


def choose_strengths(samples: Samples, labels: NDArray[np.bool_], folds: list[Fold]) -> Matrix:
    """For each label column the C of the grid with the lowest held-out log-loss; the smaller one on ties."""
    loss = np.zeros((STRENGTHS.size, labels.shape[1]))
    for fold in folds:
        train = samples.of(fold.train)
        coordinates = Coordinates.fit(train.features)
        held_out, truth = coordinates(samples.of(fold.test).means), labels[fold.test]
        solver = LogisticSolver(coordinates.train)
        for step, weights in enumerate(solver.path(train.repeat(labels[fold.train]), STRENGTHS)):
            loss[step] += log_loss(to_numpy(held_out @ weights), truth) * fold.test.size
    chosen: Matrix = STRENGTHS[loss.round(9).argmin(axis=0)]  # rounded, so that equal losses are ties
    return chosen


def _fit_fold(samples: Samples, labels: NDArray[np.bool_], fold: Fold, strengths: Matrix) -> FittedFold:
    train = samples.of(fold.train)
    coordinates = Coordinates.fit(train.features)
    solver = LogisticSolver(coordinates.train)
    held_out, training_labels = coordinates(samples.of(fold.test).means), train.repeat(labels[fold.train])
    decisions = np.empty((fold.test.size, labels.shape[1]))
    for strength in np.unique(strengths):
        columns = np.flatnonzero(strengths == strength)
        (weights,) = solver.path(training_labels[:, columns], np.array([strength]))
        decisions[:, columns] = to_numpy(held_out @ weights)
        if columns[0] == 0:
            first = weights[:, 0]
    raw, intercept = coordinates.raw_weights(first)
    along = float(np.std(to_numpy(coordinates.train @ first)))
    length = float(np.linalg.norm(raw))
    return FittedFold(decisions, strengths, raw, intercept, along / length if length else 0.0)


def _out_of_fold(fitted: list[FittedFold], folds: list[NestedFold]) -> Matrix:
    """(E, K) decisions, each episode's from the fold that tests it."""
    tested = np.concatenate([fold.outer.test for fold in folds])
    decisions: Matrix = np.concatenate([fold.decisions for fold in fitted])[np.argsort(tested)]
    return decisions
