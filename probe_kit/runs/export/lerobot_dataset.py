"""A run as a LeRobotDataset, written by lerobot itself: frames, state and actions step by step."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit._system.imports import require
from probe_kit._system.machine import same_scheduling
from probe_kit.env.scoring import MOTION, STATE
from probe_kit.errors import UsageError
from probe_kit.runs.run import Run
from probe_kit.runs.small_frames import SmallFrames
from probe_kit.runs.thumbnails import decode_frames, read_sheet

CAMERA = "observation.images.scene"
EPISODES = "probe_kit_episodes.csv"
"""In `meta`: a row per episode of the data set with all that the run says of it; lerobot does not read it."""
_STATE = [*STATE["tool"], "opening"]


@same_scheduling()
def write_lerobot(run: Run, folder: Path) -> None:
    """The data set in `folder`: an episode of T steps has T rows, each with what the policy did next.

    `observation.state` is the measured tool, x, y, z, roll, pitch, yaw in metres and radians, and the opening of
    the gripper; `action` is the commanded action. The frame behind the last action is left out.
    Raises UsageError for a run without all frames, NoTrajectoryError, MissingExtraError, and RunDamagedError.
    """
    for needed in ("datasets", "av"):
        require(needed, "datasets")
    datasets = require("lerobot.datasets.lerobot_dataset", "datasets")
    require("datasets", "datasets").disable_progress_bars()
    trajectories, data = run.trajectories, None
    for position, (row, frames) in enumerate(_filmed_episodes(run)):
        trajectory = trajectories[position]
        if data is None:
            data = datasets.LeRobotDataset.create(
                f"probe_kit/{run.location.name}", round(_control_rate(run)), _features(frames[0].shape),
                root=folder, robot_type=str(run.settings["scene"]["arm"]),
            )  # fmt: skip
        for step in range(trajectory.steps):
            state = np.append(trajectory.tool[step], trajectory.opening[step]).astype(np.float32)
            data.add_frame(
                {
                    CAMERA: frames[step],
                    "observation.state": state,
                    "action": trajectory.commanded[step].astype(np.float32),
                    "task": str(row["instruction"]),
                }
            )
        data.save_episode()
    if data is not None:
        data.finalize()
    table = run.episodes.rename_axis("episode_index")
    table.to_csv(folder / "meta" / EPISODES)


def _features(shape: tuple[int, ...]) -> dict[str, Any]:
    return {
        CAMERA: {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": (len(_STATE),), "names": _STATE},
        "action": {"dtype": "float32", "shape": (len(MOTION),), "names": list(MOTION)},
    }


def _filmed_episodes(run: Run) -> Iterator[tuple[dict[str, Any], SmallFrames]]:
    """The row and the frames of every episode: one before the first action, one behind each.

    Raises UsageError before the first if an episode was played without `--frames all`, or its frames were deleted.
    """
    rows = run.episodes.to_dict("records")
    for commit in run.commits():
        if commit.frames is None:
            raise UsageError(
                f"{run.location} does not keep every frame of episode {commit.episode_id}. Extract it again to "
                "another --out, with --frames all"
            )
    for row in rows:
        sheet = read_sheet(run.location, int(row["episode"]))
        if sheet is None or sheet.count is None:
            raise UsageError(f"{run.location} has lost its frames; its folder of pictures was deleted")
        yield {str(name): value for name, value in row.items()}, decode_frames(sheet.content, sheet.count)


def _control_rate(run: Run) -> float:
    """Actions per second of the run's scene. Raises UsageError for a run without a scene."""
    scene = run.settings.get("scene")
    if scene is None:
        raise UsageError(f"{run.location} was not played in a scene")
    return float(scene["physics"]["rate"] / scene["physics"]["substeps"])
