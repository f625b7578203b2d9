"""Times of an episode's events: the arm starts, grasps the cube, commits to a side, releases the cube."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.env.scoring.trajectory import Trajectory

MOTION = 0.005
"""Metres the tool has to leave its first place by to have set off; less is the arm settling."""
LATERAL = 0.02
"""Metres towards either tile, of some 0.31 between them, by which the tool has committed to a side."""

EVENTS = ("first motion", "grasp", "first lateral move", "release")


@dataclass(frozen=True)
class Events:
    """Frames of one episode at which something was first the case; None for what never happened.

    first_motion: the tool has left its place. grasp: the cube is held. first_lateral_move: after the grasp, the
    tool has moved `LATERAL` along the line between the tiles from where it grasped: before the grasp it goes
    where the cube is, whatever the question. release: the cube is not held any more, and not again. Frame t
    follows action t, so that the action with that number brought it about.
    """

    first_motion: int | None
    grasp: int | None
    first_lateral_move: int | None
    release: int | None

    @classmethod
    def of(cls, trajectory: Trajectory) -> "Events":
        """Return the events of a trajectory, from the positions frame by frame."""
        tool = trajectory.tool[:, :3].astype(np.float64)
        grasp = _first(trajectory.held)
        frames = np.flatnonzero(trajectory.held)
        release = None if frames.size == 0 or frames[-1] + 1 == len(trajectory) else int(frames[-1]) + 1
        return cls(
            first_motion=_first(np.linalg.norm(tool - tool[0], axis=1) > MOTION),
            grasp=grasp,
            first_lateral_move=None if grasp is None else _lateral(trajectory, tool, grasp),
            release=release,
        )

    def frame(self, event: str) -> int | None:
        """Return the frame of an event by its name in `EVENTS`."""
        frame: int | None = getattr(self, event.replace(" ", "_"))
        return frame


def _lateral(trajectory: Trajectory, tool: NDArray[np.float64], grasp: int) -> int | None:
    across = (trajectory.tile_left[0, :2] - trajectory.tile_right[0, :2]).astype(np.float64)
    length = float(np.linalg.norm(across))
    if length == 0:
        return None
    moved = np.abs((tool[:, :2] - tool[grasp, :2]) @ (across / length))
    moved[: grasp + 1] = 0
    return _first(moved > LATERAL)


def _first(happened: NDArray[np.bool_]) -> int | None:
    frames = np.flatnonzero(happened)
    return int(frames[0]) if frames.size else None
