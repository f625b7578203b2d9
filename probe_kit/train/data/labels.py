"""Labels of probes: the correct side, the chosen side, or a shuffled control."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.statistics.label_permutations import flip_items
from probe_kit.train.choices import TARGETS, Target
from probe_kit.train.data.run_reader import check_several_wordings

if TYPE_CHECKING:
    import pandas as pd


def target_labels(episodes: "pd.DataFrame", target: Target, seed: int) -> NDArray[np.int8]:
    """Label of every episode, (E,): 1 left, 0 right, −1 where the target is not defined.

    Raises UsageError for an unknown target, and for episodes of several wordings.
    """
    check_several_wordings(episodes)
    if target == "chosen":
        return _left_is_one(episodes["side_placed"])
    labels = _left_is_one(episodes["side_correct"])
    if target == "correct":
        return labels
    if target == "shuffled":
        flipped = flip_items(labels == 1, episodes["item_id"], 1, derive_seed("shuffled target", seed))
        return flipped[:, 0].astype(np.int8)
    raise UsageError(f"unknown target {target!r}; expected one of {', '.join(TARGETS)}")


def _left_is_one(sides: "pd.Series[str]") -> NDArray[np.int8]:
    return np.select([sides == "left", sides == "right"], [np.int8(1), np.int8(0)], np.int8(-1))
