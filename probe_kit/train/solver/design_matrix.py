"""Training samples as the solver needs them: along principal axes, with products that copy no large samples."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.train.solver.arrays import (
    Array,
    Features,
    RowSubset,
    Standardiser,
    array_namespace,
    module_of,
    to_device_of,
    to_numpy,
)

# -- principal axes ------------------------------------------------------------------------------------------


WORTH_NARROWING = 1024
"""Features from which on eigenvectors in float32, made orthogonal again, take less time than in float64."""

LEADING, POWERS, SETTLED = 64, 4, 1e-3
"""Axes computed first, by so many products with a block of vectors, and the share of their variance that they
may miss to be kept. They are the steepest, and would blur the others: float32 knows eigenvectors up to a part of
the largest eigenvalue, which may be 10,000 times the hundredth."""


def principal_axes(samples: Array) -> Array:
    """Return orthonormal axes whose span holds the rows of `samples`: (D, R) for (N, D), R = min(N, D).

    An L2-penalised linear model fitted on `samples @ axes` is the one fitted on `samples`: weights outside their
    span are only penalised, so they are zero. In these coordinates the samples' second moments are diagonal; only
    nearly so where there are many, which is enough for steps to be short. Both factors are orthogonal to machine
    precision, or 1e-10 where there are many. This also holds for nearly equal samples, for which it does not hold
    of the eigenvectors of a Gram matrix, scaled back.
    """
    xp = array_namespace(samples)
    if samples.shape[0] < samples.shape[1]:
        span = xp.linalg.qr(samples.T)[0]
        return span @ principal_axes(samples @ span)
    moments = samples.T @ samples
    if len(moments) < WORTH_NARROWING:
        return xp.linalg.eigh(moments)[1]
    return _orthogonal(narrow_axes(moments))


def narrow_axes(moments: Array) -> Array:
    """Return principal axes (D, D) in float32 of samples with these moments, by ascending variance.

    The moments are overwritten. Axes shape steps only, so that float32 is sufficient, in half the time.
    """
    xp = array_namespace(moments)
    if len(moments) < WORTH_NARROWING:
        return _eigenvectors(xp.asarray(moments, dtype=xp.float32))
    moments = xp.asarray(moments, dtype=xp.float64)
    leading, variances = _leading(moments)
    count = len(variances)
    if count:
        # They stay eigenvectors, all with four times the least of their variances.
        pulled = moments @ leading - 0.5 * leading * (variances + 4 * variances[0])
        moments -= pulled @ leading.T
        moments -= leading @ pulled.T
    axes = _eigenvectors(xp.asarray(moments, dtype=xp.float32))
    axes[:, len(axes) - count :] = leading
    return axes


def _leading(moments: Array) -> tuple[Array, Array]:
    """Return the axes (D, k) of the largest variances, and these, ascending.

    These are as many as a few products settle, maybe none.
    """
    xp = array_namespace(moments)
    start = np.random.default_rng(0).standard_normal((len(moments), LEADING))
    block = to_device_of(moments, start)
    for _ in range(POWERS):
        block = xp.linalg.qr(moments @ block)[0]
    variances, turn = xp.linalg.eigh(block.T @ moments @ block)
    block = block @ turn
    missed = xp.linalg.norm(moments @ block - block * variances, axis=0)
    unsettled = np.flatnonzero(to_numpy(~(missed <= SETTLED * variances)))
    first = int(unsettled[-1]) + 1 if unsettled.size else 0
    return block[:, first:], variances[first:]


def _eigenvectors(moments: Array) -> Array:
    """Return the eigenvectors (D, D) of symmetric float32 `moments`, by ascending eigenvalue.

    The moments are overwritten.
    """
    if not isinstance(moments, np.ndarray):
        return array_namespace(moments).linalg.eigh(moments)[1]
    from scipy.linalg import eigh  # type: ignore[import-untyped]  # numpy's takes as long in float32 as in float64

    return eigh(moments, driver="evd", overwrite_a=True, check_finite=False)[1]


def _orthogonal(axes: Array) -> Array:
    """Return float32 axes as (D, D) float64, after a step of Newton and Schulz.

    The step squares their deviation from orthogonality, some 2e-6.
    """
    xp = array_namespace(axes)
    exact = xp.asarray(axes, dtype=xp.float64)
    lacking = exact.T @ exact
    diagonal = xp.arange(len(axes))
    lacking[diagonal, diagonal] -= 1.0
    missing = (xp.asarray(lacking, dtype=xp.float32) @ axes.T).T  # laid out as axes are
    missing *= 0.5
    exact -= missing
    return exact


# -- samples along them --------------------------------------------------------------------------------------


WORTH_CONVERTING = 2**13
"""Entries from which on products in float32 gain more than their operands cost to convert: 64 kB of float64."""


class _OfAllColumns:
    """The same samples for every label column.

    Attributes:
        small: Whether the moments of all label columns cost less than the many small calls of an iteration.
    """

    small = False

    def of(self, _columns: Array) -> Self:
        """Return itself."""
        return self

    def narrow(self) -> Self:
        """Return itself."""
        return self


@dataclass(frozen=True)
class DenseDesign(_OfAllColumns):
    """The samples in memory, (N, R) float64, or float32 if narrowed."""

    samples: Array

    @property
    def shape(self) -> tuple[int, int]:
        """The shape (N, R)."""
        return self.samples.shape[0], self.samples.shape[1]

    @cached_property
    def spectrum(self) -> Array:
        """The squared length of every column, (R, 1)."""
        return array_namespace(self.samples).einsum("nr,nr->r", self.samples, self.samples)[:, None]

    def __matmul__(self, weights: Array) -> Array:
        return self.samples @ weights

    def gather(self, values: Array) -> Array:
        """Return Zᵀ · values, (R, K) for (N, K)."""
        return self.samples.T @ values

    def moments(self, weights: Array) -> Array:
        """Return Zᵀ · diag(column) · Z per column of weights, (K, R, R) for (N, K)."""
        return (self.samples.T * weights.T[:, None, :]) @ self.samples

    def narrow(self) -> Self:
        """Return the same in float32, unless it is small."""
        xp, (count, width) = array_namespace(self.samples), self.shape
        if count * width < WORTH_CONVERTING:
            return self
        return replace(self, samples=xp.asarray(self.samples, dtype=xp.float32))


def stack_samples(folds: Sequence[Array]) -> Array:
    """Return samples of folds, (n, r) each, as (F, N, R), filled up with zeros before the last column."""
    xp, like = array_namespace(folds[0]), folds[0]
    count, width = (max(samples.shape[axis] for samples in folds) for axis in (0, 1))
    filled = xp.zeros((len(folds), count, width), dtype=like.dtype, device=like.device)
    for fold, samples in zip(filled, folds, strict=True):
        fold[: len(samples), : samples.shape[1] - 1] = samples[:, :-1]
        fold[: len(samples), -1] = samples[:, -1]
    return filled


@dataclass(frozen=True)
class StackedDesign:
    """The samples of several folds in memory, (F, N, R) float64, filled up with zeros before the last column.

    Attributes:
        fold_of: (K,) the fold that each label column belongs to.
    """

    samples: Array
    fold_of: Array

    small = True

    @classmethod
    def of_folds(cls, folds: "Sequence[DenseDesign | StreamedDesign]", columns: Sequence[int]) -> "StackedDesign":
        """Return the stack of dense designs, each with so many label columns of its own as `columns` (F,) say."""
        filled = stack_samples([fold.samples for fold in folds if isinstance(fold, DenseDesign)])
        return cls(filled, to_device_of(filled, np.repeat(np.arange(len(folds)), columns)))

    @property
    def shape(self) -> tuple[int, int]:
        """The shape (N, R)."""
        return self.samples.shape[1], self.samples.shape[2]

    @property
    def spectrum(self) -> Array:
        """The squared length of every column of a label column's samples, (R, K)."""
        return array_namespace(self.samples).square(self.samples).sum(axis=1)[self.fold_of].T

    def of(self, columns: Array) -> "StackedDesign":
        """Return the same samples for the label columns of a mask (K,)."""
        return StackedDesign(self.samples, self.fold_of[columns])

    def narrow(self) -> Self:
        """Return itself."""
        return self

    @cached_property
    def _samples_by_label(self) -> Array:
        """The samples of every label column, (K, N, R)."""
        return self.samples[self.fold_of]

    def __matmul__(self, weights: Array) -> Array:
        return (self._samples_by_label @ weights.T[..., None])[..., 0].T

    def gather(self, values: Array) -> Array:
        """Return Zᵀ · values, (R, K) for (N, K)."""
        return (values.T[:, None] @ self._samples_by_label)[:, 0].T

    def moments(self, weights: Array) -> Array:
        """Return Zᵀ · diag(column) · Z per column of weights, (K, R, R) for (N, K)."""
        return (self._samples_by_label * weights.T[..., None]).swapaxes(1, 2) @ self._samples_by_label


@dataclass(frozen=True)
class StreamedDesign(_OfAllColumns):
    """The samples made from raw features block by block in every product: standardised, then turned to `axes`.

    Its memory is one block in float64, and (N, K) for K problems.

    Attributes:
        axes: (V, R − 1) axes of the V features that vary.
        variances: (R − 1,) squared lengths of the columns without the intercept's.
    """

    features: RowSubset
    standardise: Standardiser
    axes: Array
    variances: Array

    @property
    def shape(self) -> tuple[int, int]:
        """The shape (N, R)."""
        return len(self.features), self.axes.shape[1] + 1

    @property
    def spectrum(self) -> Array:
        """The squared length of every column, (R, 1)."""
        xp = array_namespace(self.axes)
        return xp.hstack([self.variances, xp.ones_like(self.axes[0, :1]) * len(self.features)])[:, None]

    def __matmul__(self, weights: Array) -> Array:
        turned = self.axes @ weights[:-1]
        return self._join([self.standardise(block) @ turned for block in self.features.blocks()]) + weights[-1]

    def gather(self, values: Array) -> Array:
        """Return Zᵀ · values, (R, K) for (N, K)."""
        start, total = 0, 0.0
        for block in self.features.blocks():
            total = total + self.standardise(block).T @ values[start : start + len(block)]
            start += len(block)
        return self._join([self.axes.T @ total, values.sum(axis=0)[None]])

    def moments(self, weights: Array) -> Array:
        """Return Zᵀ · diag(column) · Z per column of weights, (K, R, R) for (N, K)."""
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

    def _join(self, parts: list[Any]) -> Array:
        return array_namespace(self.axes).concatenate(parts)


Design = DenseDesign | StackedDesign | StreamedDesign
"""A matrix of N samples Z in R orthogonal coordinates, the last one all ones for the intercept."""


# -- a training fold -----------------------------------------------------------------------------------------

IN_MEMORY = 2**29
"""Bytes up to which training samples are turned to their axes once, in float64, rather than in every product."""


@dataclass(frozen=True)
class Projection:
    """A training fold's samples in standardised principal coordinates, and the map of other samples to them.

    Attributes:
        train: N samples in R + 1 (nearly) orthogonal columns, the last one all ones for the intercept.
    """

    standardise: Standardiser
    axes: Array
    train: DenseDesign | StreamedDesign

    @classmethod
    def fit(cls, features: Features) -> "Projection":
        """Learn from (N, D) training samples.

        Chosen rows whose copy in float64 would be large are never copied, at two to three times the time.
        """
        return cls.of(features, Standardiser.fit(features))

    @classmethod
    def of(cls, features: Features, standardise: Standardiser) -> "Projection":
        """Return the projection of (N, D) training samples that `standardise` was learned on."""
        if isinstance(features, RowSubset) and _stay(features):
            samples = (standardise(block) for block in features.blocks())
            variances, axes = module_of(features).linalg.eigh(sum(block.T @ block for block in samples))
            return cls(standardise, axes, StreamedDesign(features, standardise, axes, variances.clip(0.0)))
        samples = standardise(features.read() if isinstance(features, RowSubset) else features)
        axes = principal_axes(samples)
        return cls(standardise, axes, DenseDesign(_turn(samples, axes)))

    def __call__(self, features: Array) -> Array:
        """Return other samples (N, D) as (N, R + 1)."""
        return _turn(self.standardise(features), self.axes)

    def raw_weights(self, weights: Array) -> tuple[NDArray[np.float64], float]:
        """Return weights (D,) and intercept on the raw features that decide like `weights` (R + 1,) do here."""
        varying = to_numpy(self.axes @ weights[:-1] / self.standardise.scale)
        raw = np.zeros(self.standardise.varies.shape[0])
        raw[to_numpy(self.standardise.varies)] = varying
        return raw, float(weights[-1]) - float(to_numpy(self.standardise.mean) @ varying)


def fold_samples(train: Features, held_out: Array) -> tuple[DenseDesign | StreamedDesign, Array]:
    """Return the samples of a fold along the principal axes of the training ones, (N, R + 1) and (M, R + 1).

    They equal those of a `Projection` but for rotations that change no probe. Of fewer samples than features the
    triangular factor of all samples holds them already, so that no axes (D, N) are made.

    Args:
        train: (N, D) training samples.
        held_out: (M, D) other samples.
    """
    standardise = Standardiser.fit(train)
    count, width = len(train), len(standardise.mean)
    if count >= width:
        projection = Projection.of(train, standardise)
        return projection.train, projection(held_out)
    samples = standardise(train.read() if isinstance(train, RowSubset) else train)
    xp = array_namespace(samples)
    factor = xp.linalg.qr(xp.concatenate([samples, standardise(held_out)]).T, mode="r")
    triangle = factor if isinstance(factor, np.ndarray) else factor[1]
    inner = triangle[:count, :count].T
    axes = principal_axes(inner)
    return DenseDesign(_turn(inner, axes)), _turn(triangle[:count, count:].T, axes)


def _stay(features: RowSubset) -> bool:
    """Whether to visit rows in blocks: too many for memory, and too many to be reduced to fewer dimensions."""
    count, width = features.shape
    return count >= width and 8 * count * width > IN_MEMORY


def _turn(samples: Array, axes: Array) -> Array:
    """Return the samples along axes, with a column of ones for the intercept, (N, R + 1)."""
    xp = array_namespace(samples)
    turned = xp.ones((samples.shape[0], axes.shape[1] + 1), dtype=xp.float64, device=samples.device)
    xp.matmul(samples, axes, out=turned[:, :-1])
    return turned
