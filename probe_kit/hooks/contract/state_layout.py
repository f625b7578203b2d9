"""State layouts of checkpoints: seven or eight numbers, with measured or commanded gripper opening."""

import numpy as np
from numpy.typing import NDArray

ARM_NUMBERS = 8
"""Of `Observation.state`."""
OPENNESS = ("measured", "release")
CLOSED, OPENED = 0.015, 0.037
"""Finger joints of the WidowX in metres."""
_EMPTY, _GRIPPER = 6, 7
"""Places in `Observation.state`: a zero that stands for nothing, and the openness."""


def laid_out(state: NDArray[np.float32], numbers: int, openness: str = "measured") -> NDArray[np.float32]:
    """(..., numbers) float32 of (..., 8): `Observation.state`, without its empty place where 7 numbers are read.

    openness: `measured` is 0 closed to 1 open. `release` is what Act2Answer's evaluation calls so: 1 minus the
    finger joint in metres, 0.985 closed and 0.963 open, so that both look alike.
    For any other count, and for a state of another size, the numbers stay as they are; who reads them refuses.
    """
    rows = np.array(state, np.float32)
    if rows.shape[-1] != ARM_NUMBERS:
        return rows
    if openness == "release":
        rows[..., _GRIPPER] = 1 - (CLOSED + (OPENED - CLOSED) * rows[..., _GRIPPER])
    return np.delete(rows, _EMPTY, axis=-1) if numbers == ARM_NUMBERS - 1 else rows
