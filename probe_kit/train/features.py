"""From raw features to the few coordinates in which a probe is solved; numpy arrays or torch tensors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.train.arrays import Array, namespace, to_numpy


@dataclass(frozen=True)
class Standardiser:
    """Mean and scale of every feature that varies, learned on training samples only.

    kept: (D,) bool, features with non-zero variance. mean, scale: (kept,) float64.
    """

    kept: Array
    mean: Array
    scale: Array

    @classmethod
    def fit(cls, features: Array) -> "Standardiser":
        """Learn from (N, D) training samples.

        A feature counts as constant when its deviation is below the rounding of its own mean.
        """
        xp = namespace(features)
        mean = features.mean(axis=0, dtype=xp.float64)
        scale = xp.sqrt(xp.square(features - mean).mean(axis=0))
        rounding = 10 * xp.finfo(features.dtype).eps * abs(mean)
        kept = scale > rounding
        return cls(kept, mean[kept], scale[kept])

    def __call__(self, features: Array) -> Array:
        """(N, D) samples as (N, kept) float64 with the training samples' mean 0 and deviation 1."""
        return (features[:, self.kept] - self.mean) / self.scale


def principal_axes(samples: Array) -> Array:
    """Orthonormal axes whose span holds the rows of `samples`: (D, R) for (N, D), R = min(N, D).

    An L2-penalised linear model fitted on `samples @ axes` is the one fitted on `samples`: what lies outside
    their span is only penalised, so its weight is zero. In these coordinates the samples' second moments are
    diagonal. Both factors are orthogonal to machine precision, also for nearly equal samples, which the
    eigenvectors of a Gram matrix, scaled back, are not.
    """
    linalg = namespace(samples).linalg
    if samples.shape[0] < samples.shape[1]:
        span = linalg.qr(samples.T)[0]
        return span @ principal_axes(samples @ span)
    return linalg.eigh(samples.T @ samples)[1]


@dataclass(frozen=True)
class Coordinates:
    """A training fold's samples in standardised principal coordinates, and the way to get others there.

    train: (N, R + 1) float64, (nearly) orthogonal columns, the last one all ones for the intercept.
    """

    standardise: Standardiser
    axes: Array
    train: Array

    @classmethod
    def fit(cls, features: Array) -> "Coordinates":
        """Learn from (N, D) training samples."""
        standardise = Standardiser.fit(features)
        samples = standardise(features)
        axes = principal_axes(samples)
        return cls(standardise, axes, _with_intercept(samples @ axes))

    def __call__(self, features: Array) -> Array:
        """(N, D) other samples as (N, R + 1)."""
        return _with_intercept(self.standardise(features) @ self.axes)

    def raw_weights(self, weights: Array) -> tuple[NDArray[np.float64], float]:
        """Weights (D,) and intercept on the raw features that decide like `weights` (R + 1,) do here."""
        kept = to_numpy(self.axes @ weights[:-1] / self.standardise.scale)
        raw = np.zeros(self.standardise.kept.shape[0])
        raw[to_numpy(self.standardise.kept)] = kept
        return raw, float(weights[-1]) - float(to_numpy(self.standardise.mean) @ kept)


def _with_intercept(coordinates: Array) -> Array:
    xp = namespace(coordinates)
    ones = xp.ones((len(coordinates), 1), dtype=xp.float64, device=coordinates.device)
    return xp.hstack([coordinates, ones])
