"""Scripted policies that need no model, and pictures in the formats of other tools."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit._system.types import Matrix, PictureArray
from probe_kit.env.act2answer import Act2AnswerEnv
from probe_kit.env.rotations import to_rpy
from probe_kit.errors import EpisodeOverError
from probe_kit.suite.items import other_side

MAX_SHIFT = 0.05
"""Largest translation of one action, in metres."""
MAX_TURN = 0.35
"""Largest rotation of one action, in radians."""
TRAVEL_HEIGHT = 0.12
"""Height of the tool above the table on the way, in metres."""
RELEASE_GAP = 0.003
"""Space between the cube and the surface below it when the fingers open, in metres."""
OPEN, CLOSED = 1.0, 0.0
STAY_SHUT = np.array([0, 0, 0, 0, 0, 0, CLOSED])


@dataclass(frozen=True)
class Waypoint:
    """A tool position (3,) and turn about +z, the gripper command on the way, and actions to wait there."""

    position: Matrix
    yaw: float
    gripper: float
    wait: int = 0


class ScriptedExpert:
    """A policy that carries the cube to the correct tile, or with `mirrored` to the wrong one.

    It uses the public actions alone. Call `reset` after each reset of the environment.

    Args:
        env: An Act2AnswerEnv, wrapped or not.
        mirrored: Whether the cube goes to the wrong tile.
        grasp_height: Height of the tool in metres; None for the middle of the cube.
        tolerance: Distance in metres at which a way-point counts as reached. Demonstrations with noise on the
            executed actions need a wider one, or the expert lingers.
    """

    def __init__(
        self, env: Any, mirrored: bool = False, grasp_height: float | None = None, tolerance: float = 1e-4
    ) -> None:
        self._env: Act2AnswerEnv = env.unwrapped
        self._mirrored = mirrored
        self._height = grasp_height
        self._tolerance = tolerance
        self._actions: Iterator[Matrix] | None = None

    def reset(self) -> None:
        """Look at the table and plan.

        Raises:
            EpisodeOverError: If the environment was not reset.
        """
        plan = self._carry() if self._env.scene_spec.start_grasped else [*self._grasp(), *self._carry()]
        self._actions = self._follow(plan)

    def act(self) -> NDArray[np.float32]:
        """Return the next action (7,) float32; once the cube is placed, the tool stays with an open gripper."""
        if self._actions is None:
            raise EpisodeOverError("the expert has no plan; call its `reset` after that of the environment.")
        return next(self._actions).astype(np.float32)

    def _grasp(self) -> list[Waypoint]:
        """Plan the grasp: over the cube, down, close, and up again."""
        x, y, _ = self._cube()
        yaw, height = self._cube_yaw(), self._grasp_height()
        above, at = np.array([x, y, TRAVEL_HEIGHT]), np.array([x, y, height])
        return [
            Waypoint(above, yaw, OPEN),
            Waypoint(at, yaw, OPEN),
            Waypoint(at, yaw, CLOSED, wait=3),
            Waypoint(above, yaw, CLOSED),
        ]

    def _carry(self) -> list[Waypoint]:
        """Plan the placement: over the tile, down to just above it, open, and up again."""
        spec, side = self._env.scene_spec, self._env.question.side_correct
        x, y = self._env.scene.tile_xy(other_side(side) if self._mirrored else side)
        height = spec.tile_height + self._grasp_height() + RELEASE_GAP
        if spec.closing_steps:
            # The hand closed around the cube where it was, which is not where the hand would take it.
            hold = self._cube() - self._env.trial.controller.target.position
            clearance = self._env.scene.arm.model.clearance
            x, y = x - hold[0], y - hold[1]
            height = spec.tile_height + max(spec.cube_side / 2 - hold[2], clearance) + RELEASE_GAP
        above, at = np.array([x, y, TRAVEL_HEIGHT]), np.array([x, y, height])
        yaw = 0.0 if spec.start_grasped else self._cube_yaw()
        return [
            Waypoint(above, yaw, CLOSED),
            Waypoint(at, yaw, CLOSED),
            Waypoint(at, yaw, OPEN, wait=2),
            Waypoint(above, yaw, OPEN),
        ]

    def _follow(self, plan: list[Waypoint]) -> Iterator[Matrix]:
        """Yield actions along the way-points, then no motion forever."""
        for waypoint in plan:
            while not self._has_arrived(waypoint):
                yield self._towards(waypoint)
            while waypoint.gripper == OPEN and self._env.trial.steps < self._env.scene_spec.forced_closed:
                yield STAY_SHUT
            for _ in range(waypoint.wait):
                yield np.array([0, 0, 0, 0, 0, 0, waypoint.gripper])
        while True:
            yield np.array([0, 0, 0, 0, 0, 0, OPEN])

    def _towards(self, waypoint: Waypoint) -> Matrix:
        shift, turn = self._remaining(waypoint)
        shift *= min(1.0, MAX_SHIFT / max(float(np.linalg.norm(shift)), 1e-9))
        return np.array([*shift, 0.0, 0.0, np.clip(turn, -MAX_TURN, MAX_TURN), waypoint.gripper])

    def _has_arrived(self, waypoint: Waypoint) -> bool:
        shift, turn = self._remaining(waypoint)
        return bool(np.linalg.norm(shift) < self._tolerance and abs(turn) < 1e-3)

    def _remaining(self, waypoint: Waypoint) -> tuple[Matrix, float]:
        """Return the translation and turn about +z from the commanded pose to the way-point."""
        target = self._env.trial.controller.target
        yaw = to_rpy(target.rotation @ np.array(self._env.scene.arm.model.down).T)[2]
        return waypoint.position - target.position, float(waypoint.yaw - yaw)

    def _cube(self) -> Matrix:
        return self._env.scene.cube_state().position

    def _cube_yaw(self) -> float:
        """Return the turn of the cube that is nearest to none; a cube looks the same after a quarter turn."""
        x, y, z, w = self._env.scene.cube_state().quaternion
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return float((yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4)

    def _grasp_height(self) -> float:
        """Return the height of the tool when the cube lies on the table between the fingers."""
        if self._height is not None:
            return self._height
        model = self._env.scene.arm.model
        return max(self._env.scene_spec.cube_side / 2 + model.hand_drop, model.clearance)


class Idle:
    """A policy that never moves the tool and leaves the gripper as at the start.

    The gripper is shut around a cube in the hand, else open.

    Args:
        env: An Act2AnswerEnv, wrapped or not.
    """

    def __init__(self, env: Any) -> None:
        self._env: Act2AnswerEnv = env.unwrapped

    def reset(self) -> None:
        """Do nothing: there is nothing to plan."""

    def act(self) -> NDArray[np.float32]:
        """Return the next action (7,) float32."""
        return np.array([0, 0, 0, 0, 0, 0, not self._env.scene_spec.start_grasped], np.float32)


# -- pictures for models elsewhere ----------------------------------------------------------------------------


def to_lerobot(observation: Mapping[str, Any]) -> dict[str, Any]:
    """Return the observation with the names of lerobot's policies, in numpy.

    `observation.images.image` is (..., 3, H, W) float32 in [0, 1]. `observation.state` is (..., 8) float32.
    Leading batch dimensions, as a vector environment adds them, stay.
    """
    image = np.asarray(observation["pixels"]["image"])
    return {
        "observation.images.image": np.moveaxis(image, -1, -3).astype(np.float32) / 255,
        "observation.state": np.asarray(observation["agent_pos"], np.float32),
    }


def to_openpi(observation: Mapping[str, Any], prompt: str, size: int = 224) -> dict[str, Any]:
    """Return one observation as an openpi policy server expects it.

    `observation/image` is (size, size, 3) uint8, the whole picture shrunk and padded with black to a square.
    `observation/state` is (8,) float32.

    Args:
        observation: Observation of the environment, without batch dimensions.
        prompt: The instruction.
        size: Side of the square picture in pixels.
    """
    return {
        "observation/image": _pad(Image.fromarray(observation["pixels"]["image"]), size),
        "observation/state": np.asarray(observation["agent_pos"], np.float32),
        "prompt": prompt,
    }


def _pad(image: Image.Image, size: int) -> Any:
    scale = size / max(image.size)
    small = image.resize((round(image.width * scale), round(image.height * scale)), Image.Resampling.BILINEAR)
    square = Image.new("RGB", (size, size))
    square.paste(small, ((size - small.width) // 2, (size - small.height) // 2))
    return np.asarray(square)


def save_gif(path: Path, pictures: Sequence[PictureArray], fps: float = 5.0) -> None:
    """Write pictures (H, W, 3) uint8 as an endless GIF; collect them with `env.render()` after each action.

    Raises:
        ValueError: If there are no pictures.
    """
    if not pictures:
        raise ValueError(f"{path}: no pictures to write; call `env.render()` at least once.")
    first, *later = (Image.fromarray(picture) for picture in pictures)
    # A GIF counts in hundredths of a second, and many players slow down anything below two of them.
    duration = max(20, round(100 / fps) * 10)
    first.save(path, save_all=True, append_images=later, duration=duration, loop=0)
