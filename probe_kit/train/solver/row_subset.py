"""Rows of a matrix that is too large to copy: selected in place and read in blocks."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.train.solver.backend import Array, array_namespace, to_device, to_numpy

ROWS_PER_BLOCK = 2048
"""32 MB of float64 at a width of 2,048."""


@dataclass(frozen=True)
class RowSubset:
    """The `rows` (N,) of `matrix` (M, D), numpy or torch. Indexing selects among them, without a copy."""

    matrix: Array
    rows: NDArray[np.intp]

    @classmethod
    def all(cls, matrix: Array) -> "RowSubset":
        """Every row."""
        return cls(matrix, np.arange(len(matrix)))

    @property
    def shape(self) -> tuple[int, int]:
        """(N, D)."""
        return len(self.rows), self.matrix.shape[1]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, rows: NDArray[np.intp]) -> "RowSubset":
        return RowSubset(self.matrix, self.rows[rows])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(to_numpy(self.read()), dtype)

    def read(self) -> Array:
        """(N, D), copied."""
        return self.matrix[self.rows]

    def blocks(self) -> Iterator[Array]:
        """All rows in order, ROWS_PER_BLOCK at a time, each block a copy."""
        for start in range(0, len(self), ROWS_PER_BLOCK):
            yield self.matrix[self.rows[start : start + ROWS_PER_BLOCK]]

    def to(self, device: str | None) -> "RowSubset":
        """The same with the matrix as a torch tensor on `device`; unchanged without one."""
        return RowSubset(to_device(self.matrix, device), self.rows)


Features = Array | RowSubset
"""(N, D) in memory, or rows that are visited block by block."""


def blocks_of(features: Features) -> Iterator[Array]:
    """The rows of `features` in blocks; an array is one block, itself."""
    return features.blocks() if isinstance(features, RowSubset) else iter([features])


def module_of(features: Features) -> Any:
    """numpy or torch, whichever holds `features`."""
    return array_namespace(features.matrix if isinstance(features, RowSubset) else features)
