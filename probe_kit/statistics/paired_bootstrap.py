"""Paired tests of a probe against a control on the same episodes, with groups of items as the unit."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.statistics.label_permutations import p_value

Matrix = NDArray[np.float64]

DRAWS = 999
"""With the observed one 1,000, so that no p is below 0.001."""
SHARED_PROBE = 1.25
"""Factor of the drawn differences of squared errors.

Groups share a probe, so two networks that know a quantity equally well differ by more than exchanges of groups
allow. Without the factor one exceeds the other in 6 to 14 % of experiments, with it in 2 to 6 %
(`label_coverage.py`).
"""


def better_than_reference(
    correct: NDArray[np.bool_] | Matrix, reference: Matrix, groups: ArrayLike, seed: int, widening: float = 1.0
) -> Matrix:
    """Family-wise p (S,) of every site against one control: is its mean score higher?

    correct: (S, E) scores, such as whether a decision is right. reference: (E,) what the control scores in each
    episode. groups: (E,). If a site is no better, a group is as likely to favour it as to oppose it: the signs of
    the groups' differences are drawn anew, the same for all sites, and the largest of them counts. widening:
    factor of the drawn differences; SHARED_PROBE for R², whose groups share a probe and so are not independent.
    """
    gain = _group_sums(correct - reference, groups)
    signs = np.where(np.random.default_rng(seed).random((gain.shape[1], DRAWS)) < 0.5, -1.0, 1.0)
    return p_value(gain.sum(axis=1), widening * (gain @ signs).max(axis=0, keepdims=True))


def better_than_best(
    correct: NDArray[np.bool_] | Matrix,
    references: NDArray[np.bool_] | Matrix,
    groups: ArrayLike,
    seed: int,
    widening: float = 1.0,
) -> Matrix:
    """Family-wise p (S,) of every site against the best of another model's: is its mean score higher?

    correct: (S, E) scores, such as whether a decision is right. references: (S', E) on the same episodes. groups:
    (E,). If the models are alike, a group's scores could as well have come from either: whole groups change
    places, and both best sites are chosen anew. widening: as in `better_than_reference`.
    """
    sums, reference_sums = _group_sums(correct, groups), _group_sums(references, groups)
    stays = (np.random.default_rng(seed).random((sums.shape[1], DRAWS)) < 0.5).astype(float)
    # A model that keeps its own groups and takes the other's elsewhere, site by site.
    shared = min(len(sums), len(reference_sums))
    mixed_here = _mixed(sums, reference_sums[_matching(len(sums), shared)], stays)
    mixed_there = _mixed(reference_sums, sums[_matching(len(reference_sums), shared)], stays)
    null = mixed_here.max(axis=0) - mixed_there.max(axis=0)
    return p_value(sums.sum(axis=1) - reference_sums.sum(axis=1).max(), widening * null[None, :])


def _mixed(sums: Matrix, other: Matrix, stays: Matrix) -> Matrix:
    """(S, draws) sums over groups, of `sums` where a group `stays` and of `other` elsewhere."""
    mixed: Matrix = sums @ stays + other @ (1 - stays)
    return mixed


def _matching(count: int, shared: int) -> NDArray[np.intp]:
    """Return for each of `count` sites the other model's that stands for it: of the same number, or the last."""
    matching: NDArray[np.intp] = np.minimum(np.arange(count), shared - 1)
    return matching


def _group_sums(values: NDArray[np.bool_] | Matrix, groups: ArrayLike) -> Matrix:
    """(S, G) sums of (S, E) over the episodes of each group."""
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    sums = np.zeros((len(values), names.size))
    np.add.at(sums.T, group_of, values.T.astype(np.float64))
    return sums
