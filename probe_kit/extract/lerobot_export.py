"""The export of a run in the scene as a LeRobotDataset that the policy of the run can be shown.

A run keeps no picture at its full size. The scene is deterministic, so that the export sets up every episode
again, executes the stored actions, and draws what the policy saw. Every state is compared with the stored one.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit._system.bounded_files import parse_json, read_regular
from probe_kit._system.imports import require
from probe_kit._system.machine import same_scheduling
from probe_kit.env import SceneSpec
from probe_kit.env.scoring import MOTION, STATE, Trajectory
from probe_kit.errors import OtherFramesError, UsageError
from probe_kit.extract.sources.scene_source import ScenePlayer, scene_row
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs.layout import FIRST_FRAME
from probe_kit.runs.reader import origin_of
from probe_kit.runs.run import Run
from probe_kit.runs.run_suite import suite_of
from probe_kit.suite.items import Episode, Item, Layout

CAMERA = "observation.images.scene"
EPISODES = "probe_kit_episodes.csv"
"""A file in `meta`: a row per episode of the data set with all that the run says of it; lerobot ignores it."""
STATE_NAMES = [*STATE["tool"], "zero", "opening"]
"""The numbers of `Observation.state` in a scene."""
OnEpisode = Callable[[int, int], None]
"""A function of the number of written episodes and of all."""


@same_scheduling()
def write_lerobot(
    run: Run,
    folder: Path,
    suite: Path | None = None,
    scene_files: Mapping[str, Path] | None = None,
    on_episode: OnEpisode | None = None,
) -> None:
    """Write the data set in `folder`: an episode of T steps has T rows, each with what the policy did next.

    The feature `observation.images.scene` is the picture as the policy gets it, (H, W, 3) uint8 without loss.
    Where the policy inferred, it is that picture bit for bit. The feature `observation.state` (8,) float32 is the
    state that the policy gets: x, y, z of the tool in metres, roll, pitch, yaw in radians, a zero, and the opening
    of the gripper. The feature `action` (7,) float32 is the commanded action. The frame behind the last action is
    left out.

    Args:
        run: A run of a scene with trajectories.
        folder: The folder to be written.
        suite: The folder of the run's suite; None for where the run had it, or for the embedded one.
        scene_files: Files of the scene that were moved, `arm_urdf` and `background`.
        on_episode: Called after every episode.

    Raises:
        UsageError: For a run that was not played in a scene.
        NoTrajectoryError: For a run without trajectories.
        SuiteError: For another suite than the run's.
        SuiteNotFoundError: For a suite that is neither given nor can be drawn again.
        SceneError: For a file of the scene that is missing or another one.
        OtherFramesError: If an episode that is played again differs from the stored one.
        MissingExtraError: Without a library of the extra `datasets`.
        RunDamagedError: For damaged bytes.
    """
    if "scene" not in run.settings:
        raise UsageError(f"{run.location} was not played in a scene; --format lerobot exports episodes of a scene")
    for needed in ("datasets", "av"):
        require(needed, "datasets")
    datasets = require("lerobot.datasets.lerobot_dataset", "datasets")
    require("datasets", "datasets").disable_progress_bars()
    stored_files = {name: path for name, path in origin_of(run).scene_files.items() if path.is_file()}
    scene = SceneSpec.from_json(run.settings["scene"], {**stored_files, **(scene_files or {})})
    items = {item.item_id: item for item in suite_of(run, suite).items}
    trajectories = run.trajectories
    player = ScenePlayer(scene)
    try:
        data = datasets.LeRobotDataset.create(
            f"probe_kit/{run.location.name}", round(scene.physics.rate / scene.physics.substeps),
            _features((*scene.picture_shape, 3)), root=folder, robot_type=scene.arm, use_videos=False,
        )  # fmt: skip
        records = run.episodes.to_dict("records")
        for position, record in enumerate(records):
            trajectory = trajectories[position]
            played = _played_again(run, player, items, record, trajectory)
            for observation, action in zip(played, trajectory.commanded, strict=True):
                data.add_frame(
                    {
                        CAMERA: observation.image,
                        "observation.state": observation.state,
                        "action": action.astype(np.float32),
                        "task": observation.instruction,
                    }
                )
            data.save_episode()
            if on_episode is not None:
                on_episode(position + 1, len(records))
        data.finalize()
    finally:
        player.close()
    _write_lens(folder / "meta" / "info.json", scene)
    run.episodes.rename_axis("episode_index").to_csv(folder / "meta" / EPISODES)


def _played_again(
    run: Run, player: ScenePlayer, items: Mapping[str, Item], record: Mapping[Any, Any], trajectory: Trajectory
) -> Iterator[Observation]:
    """Yield what the policy was shown before each action of an episode.

    Raises:
        OtherFramesError: If the first frame or a state is not the stored one.
    """
    item = replace(items[str(record["item_id"])], instruction=str(record["instruction"]))
    layout: Layout = "original" if record["layout"] == "original" else "swapped"
    row = scene_row(0, Episode(item, layout), int(record["scene_seed"]), 0)
    execute = int(run.settings["execute"] or 1)
    for step, (observation, drawn) in enumerate(player.play_again(row, trajectory.commanded, execute)):
        stored = np.array([*trajectory.tool[step], 0.0, trajectory.opening[step]], np.float32)
        is_other_frame = step == 0 and drawn != record.get(FIRST_FRAME, drawn)
        if is_other_frame or not np.array_equal(observation.state, stored):
            what = "frame" if is_other_frame else "state"
            raise OtherFramesError(
                f"{record['episode_id']}, played again, has another {what} at step {step} than {run.location} "
                "stores. Its pictures, its scene or the simulator are others here; use the machine and versions "
                "that its provenance names"
            )
        yield observation


def _features(shape: tuple[int, ...]) -> dict[str, Any]:
    return {
        CAMERA: {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": STATE_NAMES},
        "action": {"dtype": "float32", "shape": (len(MOTION),), "names": list(MOTION)},
    }


def _write_lens(file: Path, scene: SceneSpec) -> None:
    """Add the camera's matrix in pixels of the picture to the description of its feature."""
    info = parse_json(read_regular(file))
    info["features"][CAMERA]["info"] = {
        **(info["features"][CAMERA].get("info") or {}),
        "intrinsics": scene.intrinsics.tolist(),
    }
    file.write_text(json.dumps(info, indent=4), encoding="utf-8")
