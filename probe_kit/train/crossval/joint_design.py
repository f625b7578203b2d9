"""The design matrix that the training sets of one site's probes share."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.train.crossval.nested_folds import NestedFold
from probe_kit.train.data.samples import Samples
from probe_kit.train.solver.backend import Array, array_namespace, to_numpy
from probe_kit.train.solver.principal_axes import narrow_axes
from probe_kit.train.solver.row_subset import RowSubset
from probe_kit.train.solver.standardiser import Moments

ROWS_PER_BLOCK = 512
"""8 MB of float64 at a width of 2,048: a block is used twice, so it should stay in the processor's cache."""

ROWS_PER_PRODUCT = 8192
"""Rows multiplied with themselves at once: products of fewer are slower, float32 sums over more less exact."""

LEAST_SCALE = 0.1
"""Deviation in a training set, as a share of the site's, below which its probes need axes of their own."""


@dataclass(frozen=True)
class Block:
    """Consecutive rows of a site, all of episodes that the same outer fold tests.

    rows: of the site. episode: (B,) episode of every row. outer: number of the outer fold that tests them.
    """

    rows: slice
    episode: NDArray[np.intp]
    outer: int


@dataclass(frozen=True)
class TrainingSets:
    """The F sets of episodes on which probes are trained: of every inner fold, then of every outer one.

    member: (F, E) float32, 1 where an episode belongs to a set. outer: (F,) the outer fold each belongs to, of
    whose test episodes it has none. counts: (F,) samples. mean, scale: (F, D) float64, what standardises a set,
    measured from the site's mean in units of its scale.
    """

    member: NDArray[np.float32]
    outer: NDArray[np.intp]
    counts: NDArray[np.float64]
    mean: Array
    scale: Array


@dataclass(frozen=True)
class JointSite:
    """M samples of E episodes, standardised by the site's own mean and scale and sorted by outer fold.

    features: (M, D) raw rows in this order. blocks: they cover all rows.
    mean, scale: (D,) float64; infinite scale for a feature that never varies. unclear: whether any feature is so
    near to never varying that training sets may disagree on it.
    axes: (D, D) float32, principal axes of the standardised samples; variances: (D,) squared lengths along them.
    turned: (M, D) float32, standardised samples along the axes: they shape steps, never a gradient that counts.
    """

    features: RowSubset
    blocks: tuple[Block, ...]
    mean: Array
    scale: Array
    unclear: bool
    sets: TrainingSets
    axes: Array
    variances: Array
    turned: Array

    @classmethod
    def of(cls, samples: Samples, folds: Sequence[NestedFold]) -> "JointSite":
        """The site of `samples`. Memory: their copy in float32, D × D a few times, and a block in float64."""
        features, blocks = _sorted(samples, folds)
        xp = array_namespace(features.matrix)
        mean, scale, rounding = Moments.of(features)
        unclear = bool(((scale > 0.25 * rounding) & (scale < 4 * rounding)).any())
        scale[scale <= rounding] = np.inf
        turned = xp.empty(features.shape, dtype=xp.float32, device=mean.device)
        moments, member = _Moments(), _members(folds, len(samples.counts))
        for block in blocks:
            exact = (features.matrix[features.rows[block.rows]] - mean) / scale
            turned[block.rows] = exact
            moments.add(exact, xp.asarray(member[:, block.episode], device=mean.device))
        counts = member @ samples.counts
        axes, variances = narrow_axes(_products(turned)), xp.zeros_like(mean)
        for block in blocks:
            turned[block.rows] = turned[block.rows] @ axes
            variances += xp.square(turned[block.rows]).sum(axis=0)
        outer = np.append(np.repeat(np.arange(len(folds)), [len(f.inner) for f in folds]), np.arange(len(folds)))
        sets = TrainingSets(member.astype(np.float32), outer, counts, *moments.standard(counts))
        return cls(features, blocks, mean, scale, unclear, sets, axes, variances, turned)

    @property
    def alike(self) -> bool:
        """Whether all training sets drop the site's constant features only, and scale the others about as it does.

        Only then do the site's axes fit them.
        """
        varies = np.isfinite(to_numpy(self.scale))
        return not self.unclear and bool((to_numpy(self.sets.scale)[:, varies] > LEAST_SCALE).all())

    def centred(self, block: Block) -> Array:
        """(B, D) float64: the block's raw rows without the site's mean."""
        return self.features.matrix[self.features.rows[block.rows]] - self.mean


@dataclass
class _Moments:
    """Sums over the rows seen so far, per training set: of every feature, and of its square."""

    sums: Array = 0.0
    squares: Array = 0.0

    def add(self, exact: Array, member: Array) -> None:
        self.sums = self.sums + member @ exact
        self.squares = self.squares + member @ exact**2

    def standard(self, counts: NDArray[np.float64]) -> tuple[Array, Array]:
        """(F, D) mean and deviation of every training set."""
        xp = array_namespace(self.sums)
        size = xp.asarray(counts, device=self.sums.device)[:, None]
        mean = self.sums / size
        return mean, xp.sqrt((self.squares / size - mean**2).clip(0.0))


def _products(rows: Array) -> Array:
    """(D, D) moments of (M, D) float32: they precondition only, so float32 will do, in half the time."""
    parts = (rows[start : start + ROWS_PER_PRODUCT] for start in range(0, len(rows), ROWS_PER_PRODUCT))
    return sum(part.T @ part for part in parts)


def training_sets(folds: Sequence[NestedFold]) -> list[NDArray[np.intp]]:
    """The episodes of every inner fold's training set, then of every outer one's."""
    return [inner.train for fold in folds for inner in fold.inner] + [fold.outer.train for fold in folds]


def _members(folds: Sequence[NestedFold], episodes: int) -> NDArray[np.float64]:
    """(F, E) 1 where an episode belongs to a training set."""
    sets = training_sets(folds)
    member = np.zeros((len(sets), episodes))
    for number, members in enumerate(sets):
        member[number, members] = 1
    return member


def _sorted(samples: Samples, folds: Sequence[NestedFold]) -> tuple[RowSubset, tuple[Block, ...]]:
    """Rows and blocks, the episodes that an outer fold tests together."""
    rows = samples.features if isinstance(samples.features, RowSubset) else RowSubset.all(samples.features)
    order = np.concatenate([fold.outer.test for fold in folds])
    sorted_ = Samples(rows, samples.counts, samples.means).of(order)
    assert isinstance(sorted_.features, RowSubset)
    episode = np.repeat(order, sorted_.counts)
    sizes = [samples.counts[fold.outer.test].sum() for fold in folds]
    return sorted_.features, tuple(_blocks(sizes, episode))


def _blocks(sizes: Iterable[int], episode: NDArray[np.intp]) -> Iterable[Block]:
    first = 0
    for fold, size in enumerate(sizes):
        for start in range(first, first + size, ROWS_PER_BLOCK):
            rows = slice(start, min(start + ROWS_PER_BLOCK, first + size))
            yield Block(rows, episode[rows], fold)
        first += size
