"""Temporal ensembling: a weighted mean of overlapping action chunks, recent chunks weighted most."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_GRIPPER_OPEN = 0.5


def ensemble(chunks: Sequence[NDArray[np.float32]], exponent: float) -> NDArray[np.float32]:
    """(7,) float32: the action for this step, from the chunks (chunk, 7) of an episode's inferences, oldest first.

    There is an inference per step, so a chunk made n steps ago contributes its n-th action, and one that is too
    old not at all. Weights grow by e^exponent from each chunk to the next; the gripper is open or closed by their
    majority.
    """
    length = len(chunks[-1])
    plans = np.array([chunk[age] for age, chunk in enumerate(reversed(chunks[-length:]))], np.float64)[::-1]
    weights = np.exp(exponent * np.arange(len(plans)))
    action = np.asarray(weights @ plans / weights.sum(), np.float32)
    action[-1] = action[-1] > _GRIPPER_OPEN
    return action
