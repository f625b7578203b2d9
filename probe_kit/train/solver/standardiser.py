"""Standardisation of features by the mean and deviation of training samples; numpy or torch."""

from dataclasses import dataclass

from probe_kit.train.solver.backend import Array
from probe_kit.train.solver.row_subset import Features, blocks_of, module_of


@dataclass(frozen=True)
class Standardiser:
    """Mean and scale of every feature that varies, learned on training samples only.

    kept: (D,) bool, features with non-zero variance. mean, scale: (kept,) float64.
    """

    kept: Array
    mean: Array
    scale: Array

    @classmethod
    def fit(cls, features: Features) -> "Standardiser":
        """Learn from (N, D) training samples.

        A feature counts as constant when its deviation is below the rounding of its own mean.
        """
        xp, count = module_of(features), len(features)
        mean = sum(block.sum(axis=0, dtype=xp.float64) for block in blocks_of(features)) / count
        scale = xp.sqrt(sum(xp.square(block - mean).sum(axis=0) for block in blocks_of(features)) / count)
        rounding = 10 * xp.finfo(next(blocks_of(features)).dtype).eps * abs(mean)
        kept = scale > rounding
        return cls(kept, mean[kept], scale[kept])

    def __call__(self, features: Array) -> Array:
        """(N, D) samples as (N, kept) float64 with the training samples' mean 0 and deviation 1."""
        samples = features[:, self.kept] - self.mean
        samples /= self.scale
        return samples
