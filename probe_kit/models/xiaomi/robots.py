"""The robots of a checkpoint: action statistics, and how each observes its scene and state."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.models.bounds import check_deviations
from probe_kit.models.statistics_choice import chosen_name

DEFAULT_ROBOT = "bridge_delta"
STATISTICS_FILE = "preprocessor_config.json"
_UNUSED = 1e-5
"""A number that varies less than this is none the robot has."""
# A hand that points down, as turns of the base frame's axes.
_POINTING_DOWN = Rotation.from_matrix([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])


@dataclass(frozen=True)
class ActionUnits:
    """Per step of a chunk and number of an action its mean and deviation, (A, D) float64 each, of one robot."""

    robot: str
    mean: NDArray[np.float64]
    deviation: NDArray[np.float64]

    @property
    def used(self) -> NDArray[np.float32]:
        """(A, D) 1 where the robot has the number, 0 where it only fills up."""
        return (self.deviation > _UNUSED).astype(np.float32)

    @property
    def sha256(self) -> str:
        """The hash of the numbers."""
        return sha256_json([self.mean.tolist(), self.deviation.tolist()])

    def restore(self, actions: NDArray[np.float32]) -> NDArray[np.float64]:
        """(…, A, D) normalised actions in the robot's units."""
        return np.asarray(actions * self.deviation + self.mean, np.float64)


def read_units(folder: Path, robot: str | None, numbers: int) -> ActionUnits:
    """Statistics of one robot from `preprocessor_config.json`; without a name, of the only one.

    robot: a name of the file, or the beginning of just one. numbers: per action, as config.json has it.
    Raises CheckpointError where there are none or they do not fit, UsageError for an unknown robot, and for
    several without a choice.
    """
    file = folder / STATISTICS_FILE
    by_robot: Mapping[str, Any] = (load_json(file) if file.is_file() else {}).get("action_config") or {}
    if not by_robot:
        raise CheckpointError(
            f"{file} has no action_config: the actions have no physical unit and no length. "
            "Take the file that the checkpoint was released with"
        )
    name = _choose(robot, by_robot, str(file))
    mean, deviation = (np.asarray(by_robot[name].get(part, []), np.float64) for part in ("mean", "std"))
    mean, deviation = (part[0] if part.ndim == 3 and len(part) == 1 else part for part in (mean, deviation))
    if mean.ndim != 2 or mean.shape != deviation.shape or mean.shape[1] != numbers:
        raise CheckpointError(
            f"{file}: {name} has mean {mean.shape} and std {deviation.shape}; expected (steps, {numbers}) each"
        )
    if not np.isfinite([mean, deviation]).all():
        raise CheckpointError(f"{file}: the statistics of {name} are not finite")
    check_deviations(mean, deviation, f"{file}, {name}")
    return ActionUnits(name, mean, deviation)


def _choose(robot: str | None, by_robot: Mapping[str, Any], source: str) -> str:
    beginning = [] if robot is None else [name for name in by_robot if name.startswith(robot)]
    return chosen_name(by_robot, beginning[0] if len(beginning) == 1 else robot, "robot", source)


@dataclass(frozen=True)
class Robot:
    """A robot's way of showing its scene and writing its state.

    heading: what its camera is called in the prompt. width, height: of its picture, in pixels.
    state: from the observation's eight numbers to its own.
    """

    name: str
    heading: str
    width: int
    height: int
    state: Callable[[NDArray[np.float32]], NDArray[np.float32]]


def _bridge_state(state: NDArray[np.float32]) -> NDArray[np.float32]:
    """Position, roll-pitch-yaw against a hand that points down, 0, openness: the observation's own layout."""
    return np.asarray(state, np.float32)


def _fractal_state(state: NDArray[np.float32]) -> NDArray[np.float32]:
    """Position, orientation of the hand as a quaternion x y z w, closedness."""
    turned = Rotation.from_euler("xyz", state[3:6]) * _POINTING_DOWN
    return np.asarray(np.concatenate([state[:3], turned.as_quat(), 1 - state[7:8]]), np.float32)


_ROBOTS = (
    Robot("bridge", "Base View", 256, 256, _bridge_state),
    Robot("fractal", "Ego View", 320, 256, _fractal_state),
)


def robot_of(name: str) -> Robot:
    """The robot whose statistics are called `name`, such as bridge_delta.

    Raises UsageError for robots with other cameras and other states than Act2Answer's arm can have.
    """
    for robot in _ROBOTS:
        if name.startswith(robot.name):
            return robot
    raise UsageError(
        f"robot {name!r} sees through other cameras and has another state than Act2Answer's arm; "
        f"choose a robot of {' or '.join(robot.name for robot in _ROBOTS)}"
    )
