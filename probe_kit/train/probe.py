"""One site's probe: nested, grouped cross-validation for the real labels and every relabelling at once."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.train.features import Coordinates
from probe_kit.train.folds import Fold, grouped_folds
from probe_kit.train.scores import correctness
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
    null: (P,) accuracies under the relabellings.
    """

    decisions: Matrix
    strengths: Matrix
    null: Matrix


def probe_site(
    features: NDArray[np.floating],
    labels: NDArray[np.bool_],
    relabellings: NDArray[np.bool_],
    folds: list[NestedFold],
) -> SiteProbe:
    """Probe (E, D) features for (E,) labels, and again for every column of (E, P) relabellings.

    Raises ProbeNotConvergedError.
    """
    columns = np.column_stack([labels, relabellings])
    decisions, strengths = cross_validate(features, columns, folds)
    return SiteProbe(
        decisions=decisions[:, 0],
        strengths=strengths[:, 0],
        null=correctness(decisions, columns)[:, 1:].mean(axis=0),
    )


def cross_validate(
    features: NDArray[np.floating], labels: NDArray[np.bool_], folds: list[NestedFold]
) -> tuple[Matrix, Matrix]:
    """Out-of-fold decision values (E, K) and the C chosen per outer fold (F, K), every column on its own.

    features: (E, D). labels: (E, K). Raises ProbeNotConvergedError.
    """
    decisions = np.full(labels.shape, np.nan)
    strengths = np.empty((len(folds), labels.shape[1]))
    for number, fold in enumerate(folds):
        strengths[number] = choose_strengths(features, labels, fold.inner)
        decisions[fold.outer.test] = _held_out_decisions(features, labels, fold.outer, strengths[number])
    return decisions, strengths


def choose_strengths(features: NDArray[np.floating], labels: NDArray[np.bool_], folds: list[Fold]) -> Matrix:
    """For each label column the C of the grid with the lowest held-out log-loss; the smaller one on ties."""
    loss = np.zeros((STRENGTHS.size, labels.shape[1]))
    for fold in folds:
        coordinates = Coordinates.fit(features[fold.train])
        held_out, truth = coordinates(features[fold.test]), labels[fold.test]
        for step, weights in enumerate(LogisticSolver(coordinates.train).path(labels[fold.train], STRENGTHS)):
            loss[step] += np.logaddexp(0.0, np.where(truth, -1.0, 1.0) * (held_out @ weights)).sum(axis=0)
    chosen: Matrix = STRENGTHS[loss.round(9).argmin(axis=0)]  # rounded, so that equal losses are ties
    return chosen


def _held_out_decisions(
    features: NDArray[np.floating], labels: NDArray[np.bool_], fold: Fold, strengths: Matrix
) -> Matrix:
    coordinates = Coordinates.fit(features[fold.train])
    solver = LogisticSolver(coordinates.train)
    held_out = coordinates(features[fold.test])
    decisions = np.empty((fold.test.size, labels.shape[1]))
    for strength in np.unique(strengths):
        columns = np.flatnonzero(strengths == strength)
        (weights,) = solver.path(labels[np.ix_(fold.train, columns)], np.array([strength]))
        decisions[:, columns] = held_out @ weights
    return decisions
