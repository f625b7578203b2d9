"""From raw features to the few coordinates in which a probe is solved."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Standardiser:
    """Mean and scale of every feature that varies, learned on training samples only.

    kept: (D,) bool, features with non-zero variance. mean, scale: (kept,) float64.
    """

    kept: NDArray[np.bool_]
    mean: Matrix
    scale: Matrix

    @classmethod
    def fit(cls, features: NDArray[np.floating]) -> "Standardiser":
        """Learn from (N, D) training samples.

        A feature counts as constant when its deviation is below the rounding of its own mean.
        """
        mean = features.mean(axis=0, dtype=np.float64)
        scale = features.std(axis=0, dtype=np.float64)
        rounding = 10 * np.finfo(features.dtype).eps * np.abs(mean)
        kept = scale > rounding
        return cls(kept, mean[kept], scale[kept])

    def __call__(self, features: NDArray[np.floating]) -> Matrix:
        """(N, D) samples as (N, kept) float64 with the training samples' mean 0 and deviation 1."""
        return (features[:, self.kept].astype(np.float64) - self.mean) / self.scale


def principal_axes(samples: Matrix) -> Matrix:
    """Orthonormal axes whose span holds the rows of `samples`: (D, R) for (N, D), R = min(N, D).

    An L2-penalised linear model fitted on `samples @ axes` is the one fitted on `samples`: what lies outside
    their span is only penalised, so its weight is zero. In these coordinates the samples' second moments are
    diagonal. Both factors are orthogonal to machine precision, also for nearly equal samples, which the
    eigenvectors of a Gram matrix, scaled back, are not.
    """
    span = np.linalg.qr(samples.T)[0] if samples.shape[0] < samples.shape[1] else np.eye(samples.shape[1])
    inside = samples @ span
    axes: Matrix = span @ np.linalg.eigh(inside.T @ inside)[1]
    return axes


@dataclass(frozen=True)
class Coordinates:
    """A training fold's samples in standardised principal coordinates, and the way to get others there.

    train: (N, R + 1) float64, (nearly) orthogonal columns, the last one all ones for the intercept.
    """

    standardise: Standardiser
    axes: Matrix
    train: Matrix

    @classmethod
    def fit(cls, features: NDArray[np.floating]) -> "Coordinates":
        """Learn from (N, D) training samples."""
        standardise = Standardiser.fit(features)
        samples = standardise(features)
        axes = principal_axes(samples)
        return cls(standardise, axes, _with_intercept(samples @ axes))

    def __call__(self, features: NDArray[np.floating]) -> Matrix:
        """(N, D) other samples as (N, R + 1)."""
        return _with_intercept(self.standardise(features) @ self.axes)

    def raw_weights(self, weights: Matrix) -> tuple[Matrix, float]:
        """Weights (D,) and intercept on the raw features that decide like `weights` (R + 1,) do here."""
        raw = np.zeros(self.standardise.kept.size)
        raw[self.standardise.kept] = self.axes @ weights[:-1] / self.standardise.scale
        return raw, float(weights[-1] - self.standardise.mean @ raw[self.standardise.kept])


def _with_intercept(coordinates: Matrix) -> Matrix:
    return np.hstack([coordinates, np.ones((len(coordinates), 1))])
