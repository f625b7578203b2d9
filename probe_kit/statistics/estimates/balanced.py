"""Balanced scores of sites: missing episodes of one side favour no site, and chance is always one half."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe_kit.errors import UnbalancedEpisodesError, UsageError

Matrix = NDArray[np.float64]

CHANCE = 0.5
"""Balanced accuracy of any answer that does not depend on the question."""


@dataclass(frozen=True)
class GroupSums:
    """Weighted correct decisions per group of items, the unit of every resampling.

    sums: (S, G) per site and group. sizes: (G,) weights of the groups, which add up to the number of episodes.
    """

    sums: Matrix
    sizes: Matrix

    @property
    def n_groups(self) -> int:
        """G."""
        return int(self.sizes.size)

    @property
    def n_episodes(self) -> float:
        """E."""
        return float(self.sizes.sum())

    @property
    def accuracies(self) -> Matrix:
        """(S,) balanced accuracies."""
        shares: Matrix = self.sums.sum(axis=1) / self.sizes.sum()
        return shares

    def only(self, sites: ArrayLike) -> "GroupSums":
        """The same for some of the sites, by position or by mask."""
        return GroupSums(self.sums[np.asarray(sites)], self.sizes)


def balanced_sums(
    decisions: Matrix, labels: NDArray[np.bool_], fold_of: ArrayLike, groups: ArrayLike
) -> GroupSums:
    """Weighted correct decisions per site and group, in the order of the groups' names.

    decisions: (S, E) out-of-fold logits for True. labels: (E,) side of every episode. fold_of: (E,) outer fold.
    groups: (E,) names. An episode of a side with n of E episodes weighs E / (2 n). In a complete run every weight
    is 1 and no decision is shifted. Raises as `remove_fold_priors` does.
    """
    right = (remove_fold_priors(decisions, labels, fold_of) > 0) == labels
    count = int(labels.sum())
    weight = np.where(labels, labels.size / (2 * count), labels.size / (2 * (labels.size - count)))
    names, group_of = np.unique(np.asarray(groups), return_inverse=True)
    member = np.zeros((labels.size, names.size))
    member[np.arange(labels.size), group_of] = weight
    return GroupSums(right.astype(np.float64) @ member, member.sum(axis=0))


def remove_fold_priors(decisions: Matrix, labels: NDArray[np.bool_], fold_of: ArrayLike) -> Matrix:
    """(S, E) out-of-fold logits without what each fold's probe learned from the shares of the sides.

    The intercept of a probe that was trained on n episodes of True and m of False holds ln(n / m), and more of its
    decisions hang on that the less it knows otherwise. labels: (E,) bool. fold_of: (E,) outer fold that tests an
    episode; all others trained its probe. Raises UsageError for a shape that does not fit, fewer than two folds,
    or NaN, and UnbalancedEpisodesError where a fold was trained on one side alone.
    """
    folds = np.asarray(fold_of)
    if decisions.ndim != 2 or not decisions.shape[1] == labels.size == folds.size:
        raise UsageError(
            f"decisions {decisions.shape}, labels {labels.shape} and folds {folds.shape}; expected (sites, "
            "episodes), and a label and a fold for each episode"
        )
    if not np.isfinite(decisions).all():
        broken = np.flatnonzero(~np.isfinite(decisions).all(axis=0))
        raise UsageError(
            f"decisions of {broken.size} of {labels.size} episodes are NaN or infinite, first number {broken[0]}, "
            "from 0 on; expected finite logits. Leave these episodes out, or fit the probes again."
        )
    names = np.unique(folds)
    if names.size < 2:
        raise UsageError(f"{names.size} outer folds; expected two or more, each tested by probes of the others")
    balanced = np.array(decisions, np.float64)
    for fold in names:
        tested = folds == fold
        yes, no = int(labels[~tested].sum()), int((~labels[~tested]).sum())
        if not (yes and no):
            raise UnbalancedEpisodesError(
                f"the probe of outer fold {fold} was trained on {yes} episodes of one side and {no} of the other; "
                "expected both sides. Extract the missing episodes."
            )
        if yes != no:
            balanced[:, tested] -= np.log(yes / no)
    return balanced
