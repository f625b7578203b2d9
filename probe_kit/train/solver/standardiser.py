"""Standardisation of features by the mean and deviation of training samples; numpy or torch."""

from dataclasses import dataclass
from typing import NamedTuple

from probe_kit.train.solver.backend import Array
from probe_kit.train.solver.row_subset import Features, blocks_of, module_of


class Moments(NamedTuple):
    """(D,) float64 each: mean and deviation of features, and the rounding of the mean in their stored type."""

    mean: Array
    scale: Array
    rounding: Array

    @classmethod
    def of(cls, features: Features) -> "Moments":
        """Return the moments of (N, D) samples.

        Sums are of differences from the first sample in float64. A feature that never varies has deviation 0, and
        a variation that is small against its offset is exact. rounding: at least one unit in the last place.
        """
        xp, count = module_of(features), len(features)
        first = xp.asarray(next(blocks_of(features))[0], dtype=xp.float64)
        shift = sum((block - first).sum(axis=0) for block in blocks_of(features)) / count
        mean = first + shift
        scale = xp.sqrt(sum(xp.square(block - first - shift).sum(axis=0) for block in blocks_of(features)) / count)
        return cls(mean, scale, xp.finfo(next(blocks_of(features)).dtype).eps * abs(mean))


@dataclass(frozen=True)
class Standardiser:
    """Mean and scale of every feature that varies, learned on training samples only.

    varies: (D,) bool, features with non-zero variance. mean, scale: (V,) float64 of these V features.
    """

    varies: Array
    mean: Array
    scale: Array

    @classmethod
    def fit(cls, features: Features) -> "Standardiser":
        """Learn from (N, D) training samples.

        A feature counts as constant when its deviation is within the rounding of its own mean: about one unit in
        the last place of the stored type.
        """
        mean, scale, rounding = Moments.of(features)
        # Divided by a deviation that is rounding, a constant feature would become noise of size 1.
        varies = scale > rounding
        return cls(varies, mean[varies], scale[varies])

    def __call__(self, features: Array) -> Array:
        """(N, D) samples as (N, V) float64 with the training samples' mean 0 and deviation 1."""
        samples = features[:, self.varies] - self.mean
        samples /= self.scale
        return samples
