"""Nested cross-validation by groups: the folds, the grid of C, and the probes of one outer fold.

Ridge probes choose their penalty λ from a grid of their own, on the same folds.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit._system.types import Matrix
from probe_kit.statistics.folds import INNER_FOLDS, OUTER_FOLDS, Fold, grouped_folds
from probe_kit.train.solver.arrays import Array, to_numpy
from probe_kit.train.solver.design_matrix import Projection

STRENGTHS: Matrix = np.array([1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0])
"""The grid of C, ascending, because `LogisticSolver.path` starts from the solution before.

Features are standardised. At the lower end a probe is nearly the direction between the class means, at the upper
end it is hardly penalised.
"""


@dataclass(frozen=True)
class NestedFold:
    """An outer fold, and the inner folds that divide its training set to choose C or λ."""

    outer: Fold
    inner: list[Fold]


def nested_folds(
    labels: NDArray[Any],
    groups: ArrayLike,
    seed: int,
    split: Callable[[NDArray[Any], ArrayLike, int, int], list[Fold]] = grouped_folds,
) -> list[NestedFold]:
    """Return outer folds for scoring, each with inner folds for choosing C; all positions refer to the E episodes.

    Raises as `split`, by default TooFewGroupsError.

    Args:
        labels: (E,) labels, or other values by which folds are balanced.
        groups: (E,) groups, which stay in one fold.
        seed: Seed of the folds.
        split: Function that makes the folds of labels, groups, their number and a seed.
    """
    group_of = np.asarray(groups)
    return [
        NestedFold(
            outer,
            [
                Fold(outer.train[inner.train], outer.train[inner.test])
                for inner in split(labels[outer.train], group_of[outer.train], INNER_FOLDS, seed)
            ],
        )
        for outer in split(labels, groups, OUTER_FOLDS, seed)
    ]


@dataclass(frozen=True)
class InnerQuality:
    """The quality of an outer fold's inner predictions, each label column at the penalty that is best by it.

    Larger is better: it is minus log-losses, minus squared errors, or shares of right classes.

    Attributes:
        total: (K,) quality summed over the training episodes.
        first: (E,) quality of the first column by episode, 0 for the episodes that the outer fold tests.
    """

    total: Matrix
    first: Matrix

    @classmethod
    def of(cls, quality: Matrix, by_episode: Matrix, best: NDArray[np.intp]) -> "InnerQuality":
        """Return the quality at chosen penalties.

        Args:
            quality: (C, K) quality along the grid.
            by_episode: (C, E) quality of the first column.
            best: (K,) positions along the grid.
        """
        return cls(np.take_along_axis(quality, best[None, :], 0)[0], by_episode[best[0]])


@dataclass(frozen=True)
class FittedFold:
    """The probes of one outer fold.

    Attributes:
        decisions: (n, K) decisions on its test episodes.
        strengths: (K,) the C chosen for each label column.
        weights: (D,) the first column's weights on raw features.
        intercept: The first column's intercept on raw features.
        spread: Deviation of its training samples along the weights.
        inner: Quality of the inner folds' predictions at the chosen C.
    """

    decisions: Matrix
    strengths: Matrix
    weights: Matrix
    intercept: float
    spread: float
    inner: InnerQuality

    @classmethod
    def of(
        cls, coordinates: Projection, weights: Array, decisions: Matrix, strengths: Matrix, inner: InnerQuality
    ) -> "FittedFold":
        """Return the fold with the first column of `weights` (R, K) in `coordinates` on raw features."""
        raw, intercept = coordinates.raw_weights(weights[:, 0])
        along = float(np.std(to_numpy(coordinates.train @ weights[:, 0])))
        length = float(np.linalg.norm(raw))
        return cls(decisions, strengths, raw, intercept, along / length if length else 0.0, inner)


LOSS_DECIMALS = 9
"""Decimals to which log-losses are compared, so that equal ones are ties."""


def select_c(loss: Matrix) -> NDArray[np.intp]:
    """Return the position of the least of `loss` (C, ...) along the grid; the smaller C on ties."""
    best: NDArray[np.intp] = loss.round(LOSS_DECIMALS).argmin(axis=0)
    return best


def can_be_least(lowest: Matrix, highest: Matrix) -> NDArray[np.bool_]:
    """Return where along the grid (C, ...) the least loss can lie, or a tie with it.

    Args:
        lowest: (C, ...) lower bounds of the losses.
        highest: (C, ...) upper bounds.
    """
    # Negated, so that what is no number stays possible.
    possible: NDArray[np.bool_] = ~(lowest > highest.min(axis=0) + 2 * 10.0**-LOSS_DECIMALS)
    return possible
