"""Physical units of MolmoAct2, as lerobot's processor steps map them: joint frame, statistics, clamp."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ObservationError
from probe_kit.hooks.families.shared.lerobot.normaliser import Normaliser


@dataclass(frozen=True)
class JointFrame:
    """The first joints in the data set's convention: sign times joint, plus offset.

    signs: 1 or -1 per joint. offsets: in the data set's units.
    """

    signs: NDArray[np.float32]
    offsets: NDArray[np.float32]

    def entered(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(..., D) of the data set from (..., D) of the robot."""
        mapped, joints = np.array(values, np.float32), len(self.signs)
        mapped[..., :joints] = self.signs * mapped[..., :joints] + self.offsets
        return mapped

    def left(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(..., D) of the robot from (..., D) of the data set."""
        mapped, joints = np.array(values, np.float32), len(self.signs)
        mapped[..., :joints] = self.signs * (mapped[..., :joints] - self.offsets)
        return mapped


SAME_FRAME = JointFrame(np.zeros(0, np.float32), np.zeros(0, np.float32))
"""The robot has the data set's convention."""


@dataclass(frozen=True)
class SteppedUnits:
    """Statistics between a joint frame and a clamp.

    unscaled: (D,) True for numbers that stay as they are, such as a gripper. clamp: whether numbers are moved to
    -1 to 1. unclamped: (D,) True for numbers of the state that the clamp leaves out.
    """

    units: Normaliser
    unscaled: NDArray[np.bool_]
    clamp: bool
    unclamped: NDArray[np.bool_]
    frame: JointFrame = SAME_FRAME

    @property
    def mode(self) -> str:
        """The kind of map."""
        return self.units.mode

    @property
    def source(self) -> str:
        """The file the statistics come from."""
        return self.units.source

    def normalise(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Physical units to the numbers the network reads; (..., D).

        Raises ObservationError for a number that stays as it is and lies outside -1 to 1, as lerobot does.
        """
        entered = self.frame.entered(values)
        outside = (np.abs(entered) > 1) & self.unscaled
        if outside.any():
            number = int(np.argwhere(outside)[0][-1])
            raise ObservationError(
                f"number {number} of the state is {entered[outside][0]:g}; this checkpoint reads it as it is, "
                "between -1 and 1 (normalize_gripper is off). Give it in these units"
            )
        mapped = np.where(self.unscaled, entered, self.units.normalise(entered))
        if self.clamp:
            mapped = np.where(self.unclamped, mapped, mapped.clip(-1, 1))
        return mapped.astype(np.float32)

    def restore(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Network output to physical units; (..., D)."""
        inside = values.clip(-1, 1) if self.clamp else values
        return self.frame.left(np.where(self.unscaled, inside, self.units.restore(inside)))

    def slope(self, numbers: int) -> NDArray[np.float32]:
        """(D,) of `restore`, where it does not clip."""
        slopes = np.where(self.unscaled, 1, self.units.slope(numbers)).astype(np.float32)
        slopes[: len(self.frame.signs)] *= self.frame.signs
        return slopes

    def slopes(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(..., D) of `restore` at these outputs of the network; 0 where it clips."""
        inside = (np.abs(values) <= 1) | (not self.clamp)
        return np.asarray(inside * self.slope(values.shape[-1]), np.float32)

    def unusual(self, values: NDArray[np.float32]) -> NDArray[np.bool_]:
        """(..., D): as without the clamp; numbers that stay as they are have no statistics."""
        return np.asarray(self.units.unusual(self.frame.entered(values)) & ~self.unscaled)
