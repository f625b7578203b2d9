"""The trajectory of one episode: poses, contacts and actions at every control step.

A frame is the state before the first action or after one; frame t follows action t. Outcome rules and everything
else that is said about behaviour are computed from it, so that no episode has to be played again for them.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.suite.items import Side

if TYPE_CHECKING:
    import xarray as xr

Values = NDArray[np.float32]

POSE: tuple[str, ...] = ("x", "y", "z", "qx", "qy", "qz", "qw")
STATE: dict[str, tuple[str, ...]] = {
    "tool": ("x", "y", "z", "roll", "pitch", "yaw"),
    "opening": ("share",),
    "cube": POSE,
    "cube_speed": ("m/s",),
    "tile_left": POSE,
    "tile_right": POSE,
    "finger_force": ("one", "other"),
    "held": ("bool",),
    "touches": ("left", "right"),
}
"""What every frame holds, and the names of its parts."""
MOTION: tuple[str, ...] = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
ACTIONS: dict[str, tuple[str, ...]] = {"commanded": MOTION, "executed": MOTION, "ik_error": ("m",)}
"""What led to a frame; not a number in the first."""
CHANNELS: tuple[str, ...] = tuple(f"{name}.{part}" for name, parts in (STATE | ACTIONS).items() for part in parts)
"""Columns of a stored frame, in order."""
_AXES = {MOTION: "motion", POSE: "pose"}
LED_TO = sum(len(parts) for parts in ACTIONS.values())
"""How many of them describe the action."""


@dataclass(frozen=True)
class Trajectory:
    """One episode of T actions in T + 1 frames; float32, metres, radians, seconds, newtons, in the world frame.

    tool: (T + 1, 6) measured x, y, z, roll, pitch, yaw, the angles relative to pointing down. opening: (T + 1,) of
    the gripper, 1 open. cube, tile_left, tile_right: (T + 1, 7) middle of the body x, y, z and its quaternion
    x, y, z, w. cube_speed: (T + 1,). finger_force: (T + 1, 2) with which each finger presses on the cube. held:
    (T + 1,) bool, both fingers touch the cube. touches: (T + 1, 2) bool, the cube touches the left or right tile.
    commanded: (T, 7) actions as they came. executed: (T, 7) what the commanded pose really advanced by, after
    limits, a gripper that is kept shut, and poses out of reach (zero then). ik_error: (T,) metres that remained.
    """

    tool: Values
    opening: Values
    cube: Values
    cube_speed: Values
    tile_left: Values
    tile_right: Values
    finger_force: Values
    held: NDArray[np.bool_]
    touches: NDArray[np.bool_]
    commanded: Values
    executed: Values
    ik_error: Values

    @classmethod
    def of_frames(cls, frames: Values) -> Self:
        """Return the trajectory of stored frames (T + 1, len(CHANNELS)); see `frames`."""
        parts: dict[str, NDArray[Any]] = {}
        start = 0
        for name, of_name in (STATE | ACTIONS).items():
            columns = frames[:, start : start + len(of_name)]
            start += len(of_name)
            columns = columns[1:] if name in ACTIONS else columns
            columns = columns[:, 0] if len(of_name) == 1 else columns
            parts[name] = columns > 0 if name in ("held", "touches") else columns
        return cls(**parts)

    @property
    def frames(self) -> Values:
        """(T + 1, len(CHANNELS)) float32 as stored: state, then the action that led to it, NaN in the first."""
        frames = np.full((len(self), len(CHANNELS)), np.nan, np.float32)
        start = 0
        for name, of_name in (STATE | ACTIONS).items():
            first = 1 if name in ACTIONS else 0
            values = getattr(self, name)
            frames[first:, start : start + len(of_name)] = values.reshape(len(values), len(of_name))
            start += len(of_name)
        return frames

    def __len__(self) -> int:
        """Number of frames, T + 1."""
        return len(self.tool)

    @property
    def steps(self) -> int:
        """Number of actions, T."""
        return len(self.commanded)

    def tile(self, side: Side) -> Values:
        """(T + 1, 7) pose of the tile on `side`."""
        return self.tile_left if side == "left" else self.tile_right

    def to_xarray(self) -> "xr.Dataset":
        """The same with labelled axes: `frame` from 0, `step` from 1, and the parts by name."""
        import xarray as xr

        arrays: dict[str, xr.DataArray] = {}
        for name, parts in (STATE | ACTIONS).items():
            time = "step" if name in ACTIONS else "frame"
            if len(parts) == 1:
                arrays[name] = xr.DataArray(getattr(self, name), dims=(time,))
            else:
                axis = _AXES.get(parts, f"{name}_part")
                arrays[name] = xr.DataArray(getattr(self, name), dims=(time, axis), coords={axis: list(parts)})
        times = {"frame": np.arange(len(self)), "step": np.arange(1, len(self))}
        return xr.Dataset(arrays, coords=times)
