"""Training samples as the solver needs them: products with them, without a full copy."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, Self

from probe_kit.train.solver.backend import Array, array_namespace
from probe_kit.train.solver.row_subset import RowSubset
from probe_kit.train.solver.standardiser import Standardiser

WORTH_NARROWING = 2**17
"""Entries from which on products in float32 gain more than their operands cost to convert: 1 MB of float64."""


class Design(Protocol):
    """N samples Z in R orthogonal coordinates, the last one all ones for the intercept."""

    @property
    def shape(self) -> tuple[int, int]:
        """(N, R)."""

    @property
    def spectrum(self) -> Array:
        """(R, 1) squared length of every column, or (R, K) where label columns have samples of their own."""

    @property
    def small(self) -> bool:
        """Whether the moments of all label columns cost less than the many small calls of an iteration."""

    def of(self, _columns: Array) -> "Design":
        """Return the samples that the label columns of a mask (K,) need."""

    def narrow(self) -> "Design":
        """The same in float32 where its products gain more than their operands cost to convert, else itself."""

    def __matmul__(self, weights: Array) -> Array:
        """Z · weights, (N, K) for (R, K)."""

    def gather(self, values: Array) -> Array:
        """Zᵀ · values, (R, K) for (N, K)."""

    def moments(self, weights: Array) -> Array:
        """Zᵀ · diag(column) · Z per column of weights, (K, R, R) for (N, K)."""


class _OfAllColumns:
    """The same samples for every label column."""

    small = False

    def of(self, _columns: Array) -> Self:
        """Itself."""
        return self

    def narrow(self) -> Self:
        """Itself."""
        return self


@dataclass(frozen=True)
class DenseDesign(_OfAllColumns):
    """Samples in memory, (N, R) float64, or float32 if narrowed."""

    samples: Array

    @property
    def shape(self) -> tuple[int, int]:
        """(N, R)."""
        return self.samples.shape[0], self.samples.shape[1]

    @cached_property
    def spectrum(self) -> Array:
        """(R, 1) squared length of every column."""
        return array_namespace(self.samples).einsum("nr,nr->r", self.samples, self.samples)[:, None]

    def __matmul__(self, weights: Array) -> Array:
        return self.samples @ weights

    def gather(self, values: Array) -> Array:
        """Zᵀ · values, (R, K) for (N, K)."""
        return self.samples.T @ values

    def moments(self, weights: Array) -> Array:
        """Zᵀ · diag(column) · Z per column of weights, (K, R, R) for (N, K)."""
        return (self.samples.T * weights.T[:, None, :]) @ self.samples

    def narrow(self) -> Self:
        """The same in float32, unless it is small."""
        xp, (count, width) = array_namespace(self.samples), self.shape
        if count * width < WORTH_NARROWING:
            return self
        return replace(self, samples=xp.asarray(self.samples, dtype=xp.float32))


@dataclass(frozen=True)
class StackedDesign:
    """Samples of several folds in memory, (F, N, R) float64, filled up with zeros before the last column.

    fold_of: (K,) the fold that each label column belongs to.
    """

    samples: Array
    fold_of: Array

    small = True

    @classmethod
    def of_folds(cls, folds: Sequence[Design], columns: int) -> "StackedDesign":
        """Return the stack of dense designs, each with so many label columns of its own."""
        dense = [fold.samples for fold in folds if isinstance(fold, DenseDesign)]
        xp, like = array_namespace(dense[0]), dense[0]
        count, width = (max(samples.shape[axis] for samples in dense) for axis in (0, 1))
        filled = xp.zeros((len(folds), count, width), dtype=like.dtype, device=like.device)
        for fold, samples in zip(filled, dense, strict=True):
            fold[: len(samples), : samples.shape[1] - 1] = samples[:, :-1]
            fold[: len(samples), -1] = samples[:, -1]
        numbers = xp.arange(len(folds) * columns, device=like.device)
        return cls(filled, numbers // columns)

    @property
    def shape(self) -> tuple[int, int]:
        """(N, R)."""
        return self.samples.shape[1], self.samples.shape[2]

    @property
    def spectrum(self) -> Array:
        """(R, K) squared length of every column of a label column's samples."""
        return array_namespace(self.samples).square(self.samples).sum(axis=1)[self.fold_of].T

    def of(self, columns: Array) -> "StackedDesign":
        """The same samples for the label columns of a mask (K,)."""
        return StackedDesign(self.samples, self.fold_of[columns])

    def narrow(self) -> Self:
        """Itself."""
        return self

    @cached_property
    def _samples_by_label(self) -> Array:
        """(K, N, R) the samples of every label column."""
        return self.samples[self.fold_of]

    def __matmul__(self, weights: Array) -> Array:
        return (self._samples_by_label @ weights.T[..., None])[..., 0].T

    def gather(self, values: Array) -> Array:
        """Zᵀ · values, (R, K) for (N, K)."""
        return (values.T[:, None] @ self._samples_by_label)[:, 0].T

    def moments(self, weights: Array) -> Array:
        """Zᵀ · diag(column) · Z per column of weights, (K, R, R) for (N, K)."""
        return (self._samples_by_label * weights.T[..., None]).swapaxes(1, 2) @ self._samples_by_label


@dataclass(frozen=True)
class StreamedDesign(_OfAllColumns):
    """Samples made from raw features block by block in every product: standardised, then turned to `axes`.

    axes: (V, R − 1) of the V features that vary. variances: (R − 1,) squared lengths of the columns without the
    intercept's. Memory is one block in float64, and (N, K) for K problems.
    """

    features: RowSubset
    standardise: Standardiser
    axes: Array
    variances: Array

    @property
    def shape(self) -> tuple[int, int]:
        """(N, R)."""
        return len(self.features), self.axes.shape[1] + 1

    @property
    def spectrum(self) -> Array:
        """(R, 1) squared length of every column."""
        xp = array_namespace(self.axes)
        return xp.hstack([self.variances, xp.ones_like(self.axes[0, :1]) * len(self.features)])[:, None]

    def __matmul__(self, weights: Array) -> Array:
        turned = self.axes @ weights[:-1]
        return self._joined([self.standardise(block) @ turned for block in self.features.blocks()]) + weights[-1]

    def gather(self, values: Array) -> Array:
        """Zᵀ · values, (R, K) for (N, K)."""
        start, total = 0, 0.0
        for block in self.features.blocks():
            total = total + self.standardise(block).T @ values[start : start + len(block)]
            start += len(block)
        return self._joined([self.axes.T @ total, values.sum(axis=0)[None]])

    def moments(self, weights: Array) -> Array:
        """Zᵀ · diag(column) · Z per column of weights, (K, R, R) for (N, K)."""
        return array_namespace(self.axes).stack([self._moments(column) for column in weights.T])

    def _moments(self, weights: Array) -> Array:
        xp, start = array_namespace(self.axes), 0
        inner, border = 0.0, 0.0
        for block in self.features.blocks():
            samples, share = self.standardise(block), weights[start : start + len(block)]
            inner = inner + (samples.T * share) @ samples
            border = border + samples.T @ share
            start += len(block)
        turned = self.axes.T @ inner @ self.axes
        edge = (self.axes.T @ border)[:, None]
        corner = weights.sum()[None, None]
        return xp.vstack([xp.hstack([turned, edge]), xp.hstack([edge.T, corner])])

    def _joined(self, parts: list[Any]) -> Array:
        return array_namespace(self.axes).concatenate(parts)
