"""The observation of a model, from the source to the network, and layouts of its state. Imports no torch."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ObservationError


@dataclass(frozen=True)
class Observation:
    """The inputs of a model at one moment.

    Attributes:
        image: (H, W, 3) uint8, the third-person camera.
        state: (8,) float32: TCP x, y, z in metres in the robot base frame; roll, pitch, yaw in radians relative to
            the gripper pointing down; 0; gripper openness in [0, 1].
        instruction: The words of the task as the source has them; the family makes its prompt of them.
        intrinsics: (3, 3) float32 pinhole matrix in pixels of `image`, x to the right and y down; None if unknown.
        cameras: Further pictures (H, W, 3) uint8 by the name of their camera.
    """

    image: NDArray[np.uint8]
    state: NDArray[np.float32]
    instruction: str
    intrinsics: NDArray[np.float32] | None = None
    cameras: Mapping[str, NDArray[np.uint8]] = field(default_factory=lambda: MappingProxyType({}))

    def __reduce__(self) -> tuple[type["Observation"], tuple[object, ...]]:
        """Pickle the cameras as a plain dict; a read-only view cannot travel between processes."""
        return Observation, (self.image, self.state, self.instruction, self.intrinsics, dict(self.cameras))

    def lacks(self, needs: frozenset[str]) -> tuple[str, ...]:
        """The parts of `needs` that this observation does not hold, sorted."""
        available = {"state"} | {f"camera.{name}" for name in self.cameras}
        if self.intrinsics is not None:
            available.add("intrinsics")
        return tuple(sorted(needs - available))


def checked_picture(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return `image`, if it is (H, W, 3) uint8.

    Raises:
        ObservationError: If it has another dtype or shape.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ObservationError(f"image is {image.dtype} {image.shape}; expected uint8 (H, W, 3)")
    return image


ARM_NUMBERS = 8
"""The count of numbers of `Observation.state`."""
OPENNESS = ("measured", "release")
"""The ways in which the gripper's openness is given to a policy, see `laid_out`."""
CLOSED, OPENED = 0.015, 0.037
"""The finger joints of the WidowX in metres, closed and open."""
_EMPTY, _GRIPPER = 6, 7
"""The places in `Observation.state` of a zero that stands for nothing, and of the openness."""


def laid_out(state: NDArray[np.float32], numbers: int, openness: str = "measured") -> NDArray[np.float32]:
    """Return `Observation.state` (..., 8) as (..., numbers) float32, without its empty place where 7 are read.

    For any other count, and for a state of another size, the numbers stay as they are; the code that reads them
    refuses.

    Args:
        state: (..., 8), see `Observation.state`.
        numbers: The count of numbers that the policy reads, 7 or 8.
        openness: `measured` is 0 closed to 1 open. `release` is the same number in Act2Answer's evaluation: 1
            minus the finger joint in metres, 0.985 closed and 0.963 open, so that both look alike.
    """
    rows = np.array(state, np.float32)
    if rows.shape[-1] != ARM_NUMBERS:
        return rows
    if openness == "release":
        rows[..., _GRIPPER] = 1 - (CLOSED + (OPENED - CLOSED) * rows[..., _GRIPPER])
    return np.delete(rows, _EMPTY, axis=-1) if numbers == ARM_NUMBERS - 1 else rows
