"""Probes of a small study, with all folds in one batch, because calls and not products take the time."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import batched

import numpy as np
from numpy.typing import NDArray

from probe_kit.statistics.folds import Fold
from probe_kit.train.crossval.metrics import log_loss
from probe_kit.train.crossval.nested_folds import STRENGTHS, FittedFold, Matrix, NestedFold, select_c
from probe_kit.train.data.samples import Samples
from probe_kit.train.solver.backend import Array, array_namespace, to_device_of, to_numpy
from probe_kit.train.solver.design_matrix import StackedDesign
from probe_kit.train.solver.logistic import LogisticSolver, check_single_class
from probe_kit.train.solver.projection import Projection

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
    inner = _at_once([one for nested in folds for one in nested.inner], labels)
    loss = np.concatenate([_Together.of(samples, labels, some).losses() for some in inner], axis=1)
    begins = np.cumsum([0, *(len(nested.inner) for nested in folds[:-1])])
    strengths: Matrix = STRENGTHS[select_c(np.add.reduceat(loss, begins, axis=1))]
    outer = zip(_at_once([one.outer for one in folds], labels), _at_once(strengths, labels), strict=True)
    return [
        fitted for some, chosen in outer for fitted in _Together.of(samples, labels, some).fitted(np.array(chosen))
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
        held_out = [one(samples.of(fold.test).means) for one, fold in zip(coordinates, folds, strict=True)]
        design = StackedDesign.of_folds([one.train for one in coordinates], labels.shape[1])
        signs = np.zeros((design.shape[0], len(folds), labels.shape[1]))
        for number, fold in enumerate(folds):
            check_single_class(labels[fold.train])
            signs[: fold.train.size, number] = 2.0 * labels[fold.train] - 1.0
        columns = to_device_of(design.samples, signs.reshape(len(signs), -1))
        return cls(folds, labels, coordinates, held_out, LogisticSolver(design), columns)

    def losses(self) -> Matrix:
        """(C, F, K) log-losses of the test episodes, summed, along the grid of C."""
        return np.array([
            [
                log_loss(to_numpy(held_out @ own), self.labels[fold.test]) * fold.test.size
                for held_out, own, fold in zip(self.held_out, self._of_folds(weights), self.folds, strict=True)
            ]
            for weights in self.solver.path_of_signs(self.signs, STRENGTHS)
        ])  # fmt: skip

    def fitted(self, strengths: Matrix) -> list[FittedFold]:
        """Of every fold, with the (F, K) chosen strengths."""
        of_columns = to_device_of(self.signs, strengths.reshape(-1))
        (weights,) = self.solver.path_of_signs(self.signs, [of_columns])
        return [
            FittedFold.of(coordinates, own, to_numpy(held_out @ own), chosen)
            for coordinates, own, held_out, chosen in zip(
                self.coordinates, self._of_folds(weights), self.held_out, strengths, strict=True
            )
        ]

    def _of_folds(self, weights: Array) -> Iterator[Array]:
        """(R, K) of every fold, without what was filled up."""
        count = self.labels.shape[1]
        for number, coordinates in enumerate(self.coordinates):
            own = weights[:, number * count : (number + 1) * count]
            rank = coordinates.train.shape[1]
            yield array_namespace(own).concatenate([own[: rank - 1], own[-1:]])
