"""InternVLA-M1's actions: from the head's output to the units of a data set."""

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.families.shared.action_statistics import ActionStatistics

_GRIPPER, _OPEN = 6, 0.5


class ActionUnits(ActionStatistics):
    """The statistics of a run. Its head puts out numbers beyond [-1, 1], and a gripper between open and closed."""

    lacking: ClassVar[str] = (
        "the checkpoint has no dataset_statistics.json: its actions have no physical unit. Take the file that the "
        "run was released with"
    )

    def restore(self, values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """(…, D) in the data set's units: clipped to [-1, 1], the gripper open or closed, then stretched."""
        clipped = np.clip(values.astype(np.float64), -1, 1)
        if clipped.shape[-1] > _GRIPPER:
            clipped[..., _GRIPPER] = clipped[..., _GRIPPER] >= _OPEN
        # In the order of the original's operations, for the last bit.
        return np.where(self.mask, 0.5 * (clipped + 1) * (self.high - self.low) + self.low, clipped)
