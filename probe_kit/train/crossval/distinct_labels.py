"""The different ones among many label columns.

Label permutations move whole groups, of which a training set may hold five: then they pose 16 logistic problems
there, however many were drawn.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.train.solver.arrays import Array, to_device_of
from probe_kit.train.solver.logistic import check_single_class


def distinct_columns(labels: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return where the different columns of (N, K) labels first occur, (U,), and each column's place among them.

    The places are (K,), counted in the order of these positions.
    """
    first: dict[bytes, int] = {}
    positions: list[int] = []
    places: list[int] = []
    for position, column in enumerate(np.ascontiguousarray(labels.T)):
        places.append(first.setdefault(column.tobytes(), len(first)))
        if places[-1] == len(positions):
            positions.append(position)
    return np.array(positions, np.intp), np.array(places, np.intp)


@dataclass(frozen=True)
class DistinctProblems:
    """The different logistic problems that K label columns pose on the same N training samples.

    Columns with exchanged classes pose the same one: their weights differ by the sign only.

    Attributes:
        labels: (N, U) labels of the problems; those of the first label column are its own.
        strengths: (U,) C of every problem; empty where one problem is solved at several C.
        problem_of: (K,) problem of every label column.
        sign: (K,) 1.0, or −1.0 for a column whose classes are exchanged in its problem.
    """

    labels: NDArray[np.bool_]
    strengths: NDArray[np.float64]
    problem_of: NDArray[np.intp]
    sign: NDArray[np.float64]

    @classmethod
    def of(cls, labels: NDArray[np.bool_], strengths: NDArray[np.float64] | None = None) -> Self:
        """Return the problems of (N, K) training labels, and of these C (K,) if they are passed.

        Raises:
            TooFewGroupsError: For a column with a single class.
        """
        check_single_class(labels)
        is_exchanged = labels[0] != labels[0, 0]
        same_way = labels ^ is_exchanged
        keys = same_way if strengths is None else np.vstack([same_way, strengths])
        positions, problem_of = distinct_columns(keys)
        at = np.zeros(0) if strengths is None else strengths[positions]
        return cls(same_way[:, positions], at, problem_of, np.where(is_exchanged, -1.0, 1.0))

    def __len__(self) -> int:
        return self.labels.shape[1]

    @property
    def signs(self) -> NDArray[np.float64]:
        """The labels as −1 and +1."""
        return np.where(self.labels, 1.0, -1.0)

    def by_column(self, weights: Array) -> Array:
        """Return the weights (R, K) of every label column from those of the problems, (R, U)."""
        return weights[:, self.problem_of] * to_device_of(weights, self.sign)
