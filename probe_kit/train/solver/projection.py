"""Projection of raw features to the few coordinates in which a probe is solved; numpy or torch."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.train.solver.backend import Array, array_namespace, to_numpy
from probe_kit.train.solver.design_matrix import DenseDesign, Design, StreamedDesign
from probe_kit.train.solver.principal_axes import principal_axes
from probe_kit.train.solver.row_subset import Features, RowSubset, module_of
from probe_kit.train.solver.standardiser import Standardiser

IN_MEMORY = 2**29
"""Bytes up to which training samples are turned to their axes once, in float64, rather than in every product."""


@dataclass(frozen=True)
class Projection:
    """A training fold's samples in standardised principal coordinates, and the way to get others there.

    train: N samples in R + 1 (nearly) orthogonal columns, the last one all ones for the intercept.
    """

    standardise: Standardiser
    axes: Array
    train: Design

    @classmethod
    def fit(cls, features: Features) -> "Projection":
        """Learn from (N, D) training samples.

        Chosen rows whose copy in float64 would be large are never copied, at two to three times the time.
        """
        standardise = Standardiser.fit(features)
        if isinstance(features, RowSubset) and _stay(features):
            samples = (standardise(block) for block in features.blocks())
            variances, axes = module_of(features).linalg.eigh(sum(block.T @ block for block in samples))
            return cls(standardise, axes, StreamedDesign(features, standardise, axes, variances.clip(0.0)))
        samples = standardise(features.read() if isinstance(features, RowSubset) else features)
        axes = principal_axes(samples)
        return cls(standardise, axes, DenseDesign(_turned(samples, axes)))

    def __call__(self, features: Array) -> Array:
        """(N, D) other samples as (N, R + 1)."""
        return _turned(self.standardise(features), self.axes)

    def raw_weights(self, weights: Array) -> tuple[NDArray[np.float64], float]:
        """Weights (D,) and intercept on the raw features that decide like `weights` (R + 1,) do here."""
        varying = to_numpy(self.axes @ weights[:-1] / self.standardise.scale)
        raw = np.zeros(self.standardise.varies.shape[0])
        raw[to_numpy(self.standardise.varies)] = varying
        return raw, float(weights[-1]) - float(to_numpy(self.standardise.mean) @ varying)


def _stay(features: RowSubset) -> bool:
    """Whether to visit rows in blocks: too many for memory, and too many to be reduced to fewer dimensions."""
    count, width = features.shape
    return count >= width and 8 * count * width > IN_MEMORY


def _turned(samples: Array, axes: Array) -> Array:
    """(N, R + 1) along axes, and a column of ones for the intercept."""
    xp = array_namespace(samples)
    turned = xp.ones((samples.shape[0], axes.shape[1] + 1), dtype=xp.float64, device=samples.device)
    xp.matmul(samples, axes, out=turned[:, :-1])
    return turned
