"""Inner qualities of made-up probes, whose decisions in the inner folds are those of the outer folds."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.statistics.crossfit import CrossFit, GroupSums, SiteScores, crossfit
from probe_kit.statistics.folds import sums_by_group


def inner_of(scores: ArrayLike, fold_of: NDArray[np.integer], groups: NDArray[np.str_]) -> NDArray[np.float32]:
    """(S, F, G) sums of (S, E) scores by group, 0 for the groups of the outer fold itself."""
    values, folds = np.asarray(scores, np.float64), np.unique(fold_of)
    parts = [sums_by_group(np.where(fold_of == fold, 0.0, values), groups) for fold in folds]
    return np.stack(parts, axis=1).astype(np.float32)


def stream_of(scores: GroupSums, layers: ArrayLike, iterations: ArrayLike | None = None) -> SiteScores:
    """Sites in five folds, whose inner qualities are their sums outside of the fold."""
    fold_of = np.arange(scores.n_groups) % 5
    inner = np.where(fold_of == np.arange(5)[:, None], 0.0, scores.sums[:, None, :])
    return SiteScores.of(scores, inner, fold_of, layers, iterations)


def fitted(*streams: SiteScores, suite: str = "suite@1") -> CrossFit:
    """The scores of streams on groups that are named by number."""
    return crossfit(streams, [f"g{number:03d}" for number in range(streams[0].fold_of.size)], suite)
