"""Shares of the image swap's displacement that something else moves the action by. Needs no model."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from probe_kit.intervene.kinds.image_swap.effects import swap_p_values
from probe_kit.intervene.store.answers import CLEAN, IMAGE_SWAP, ConditionOutcomes
from probe_kit.statistics.bootstrap import draw_groups, units_seed
from probe_kit.statistics.significance import SIGNIFICANCE


class SwapShare(NamedTuple):
    """A ratio of sums over episodes, with its 95 % interval by groups; 1 is the whole swap."""

    value: float
    low: float
    high: float


def share_of_swap(outcomes: ConditionOutcomes, moved: NDArray[np.float64], seed_text: str) -> SwapShare | None:
    """What `moved` (E,) metres is of the swap's displacement in the same episodes of one category.

    None if images were not swapped, or if that moves the action by no more than chance: a share would be a ratio
    of noise. Groups are drawn for both sums together.
    """
    if IMAGE_SWAP not in outcomes.conditions or min(swap_p_values(outcomes)) >= SIGNIFICANCE:
        return None
    return share_of_whole(moved, outcomes.of(IMAGE_SWAP) - outcomes.of(CLEAN), outcomes.groups, seed_text)


def share_of_whole(
    moved: NDArray[np.float64], whole: NDArray[np.float64], groups: NDArray[np.str_], seed_text: str
) -> SwapShare:
    """Σ moved · whole / Σ whole² over episodes (E,), with its interval by groups (E,). seed_text: of the draws."""
    names, group_of = np.unique(groups, return_inverse=True)
    above, below = np.bincount(group_of, moved * whole), np.bincount(group_of, whole**2)
    times = draw_groups(names.size, units_seed(groups, seed_text))
    drawn = (times @ above) / np.maximum(times @ below, np.finfo(float).tiny)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return SwapShare(float(above.sum() / below.sum()), float(low), float(high))
