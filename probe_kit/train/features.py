"""From raw features to the few coordinates in which a probe is solved; numpy arrays or torch tensors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.train.arrays import Array, namespace, to_numpy
from probe_kit.train.design import DenseDesign, Design, StreamedDesign
from probe_kit.train.rows import ChosenRows, Features, module_of
from probe_kit.train.standardiser import Standardiser

IN_MEMORY = 2**29
"""Bytes up to which training samples are turned to their axes once, in float64, rather than in every product."""


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

    train: N samples in R + 1 (nearly) orthogonal columns, the last one all ones for the intercept.
    """

    standardise: Standardiser
    axes: Array
    train: Design

    @classmethod
    def fit(cls, features: Features) -> "Coordinates":
        """Learn from (N, D) training samples.

        Chosen rows whose copy in float64 would be large are never copied, at two to three times the time.
        """
        standardise = Standardiser.fit(features)
        if isinstance(features, ChosenRows) and _stay(features):
            samples = (standardise(block) for block in features.blocks())
            variances, axes = module_of(features).linalg.eigh(sum(block.T @ block for block in samples))
            return cls(standardise, axes, StreamedDesign(features, standardise, axes, variances.clip(0.0)))
        samples = standardise(features.read() if isinstance(features, ChosenRows) else features)
        axes = principal_axes(samples)
        return cls(standardise, axes, DenseDesign(_with_intercept(samples @ axes)))

    def __call__(self, features: Array) -> Array:
        """(N, D) other samples as (N, R + 1)."""
        return _with_intercept(self.standardise(features) @ self.axes)

    def raw_weights(self, weights: Array) -> tuple[NDArray[np.float64], float]:
        """Weights (D,) and intercept on the raw features that decide like `weights` (R + 1,) do here."""
        kept = to_numpy(self.axes @ weights[:-1] / self.standardise.scale)
        raw = np.zeros(self.standardise.kept.shape[0])
        raw[to_numpy(self.standardise.kept)] = kept
        return raw, float(weights[-1]) - float(to_numpy(self.standardise.mean) @ kept)


def _stay(features: ChosenRows) -> bool:
    """Whether to visit rows in blocks: too many for memory, and too many to be reduced to fewer dimensions."""
    count, width = features.shape
    return count >= width and 8 * count * width > IN_MEMORY


def _with_intercept(coordinates: Array) -> Array:
    xp = namespace(coordinates)
    ones = xp.ones((len(coordinates), 1), dtype=xp.float64, device=coordinates.device)
    return xp.hstack([coordinates, ones])
