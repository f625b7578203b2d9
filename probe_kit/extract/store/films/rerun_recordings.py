"""Episodes of a run as recordings of rerun, one file each: camera, bodies and actions on one time axis."""

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit._system.optional_dependencies import require
from probe_kit.env.scoring.trajectory import MOTION, Trajectory
from probe_kit.env.spec import SceneSpec
from probe_kit.extract.store.films.filmed_episodes import (
    FilmedEpisode,
    control_rate,
    episode_name,
    filmed_episodes,
)
from probe_kit.extract.store.run import Run

APPLICATION = "probe_kit"
JPEG_QUALITY = 90
STEP, SECONDS = "step", "seconds"
"""Timelines: frame t is the state after action t, and 0 the one before the first."""
_POSES = ("cube", "tile_left", "tile_right")


def write_rerun(run: Run, folder: Path) -> None:
    """One recording per episode, `<number>-<category>-<outcome>.rrd`, of T + 1 frames.

    `camera`: the frames as JPEG. `scene/tool`, `scene/cube`, `scene/tile_left`, `scene/tile_right`: poses in the
    world, metres. `action/commanded`, `action/executed`: (7,) at the frame that they led to; `gripper/opening`.
    `instruction`: the text. Property `episode`: the columns of `run.episodes`, as JSON where no text or number.
    Raises UsageError for a run without all frames, NoTrajectoryError, MissingExtraError, and RunDamagedError.
    """
    require("rerun", "rerun")
    rate, trajectories = control_rate(run), run.trajectories
    sizes = _half_sizes(run.settings["scene"])
    for one in filmed_episodes(run):
        folder.mkdir(exist_ok=True)
        path = folder / f"{episode_name(one)}.rrd"
        _write(path, run.location.name, one, trajectories[one.position], sizes, rate)


def _half_sizes(scene: dict[str, Any]) -> dict[str, list[float]]:
    default = SceneSpec()
    cube, side, height = (
        float(scene.get(name, getattr(default, name))) / 2 for name in ("cube_side", "tile_side", "tile_height")
    )
    return {"cube": [cube] * 3, "tile_left": [side, side, height], "tile_right": [side, side, height]}


def _write(
    path: Path, name: str, one: FilmedEpisode, seen: Trajectory, sizes: dict[str, list[float]], rate: float
) -> None:
    rr = require("rerun", "rerun")
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{name} {path.stem}")
    recording.save(str(path))
    recording.send_recording_name(path.stem)
    recording.send_property("episode", rr.AnyValues(**{key: _plain(value) for key, value in one.row.items()}))
    recording.log("instruction", rr.TextDocument(str(one.row["instruction"])), static=True)
    frames = np.arange(len(seen))

    def send(entity: str, columns: Any, at: NDArray[np.int_] = frames) -> None:
        times = [rr.TimeColumn(STEP, sequence=at), rr.TimeColumn(SECONDS, duration=at / rate)]
        recording.send_columns(entity, times, columns)

    pictures = [_as_jpeg(frame) for frame in one.frames]
    kinds = ["image/jpeg"] * len(pictures)
    send("camera", rr.EncodedImage.columns(blob=pictures, media_type=kinds), np.arange(len(pictures)))
    send("scene/tool", rr.Points3D.columns(positions=seen.tool[:, :3]))
    for body in _POSES:
        pose = getattr(seen, body)
        recording.log(f"scene/{body}", rr.Boxes3D(half_sizes=[sizes[body]]), static=True)
        send(f"scene/{body}", rr.Transform3D.columns(translation=pose[:, :3], quaternion=pose[:, 3:]))
    for kind in ("commanded", "executed"):
        recording.log(f"action/{kind}", rr.SeriesLines(names=list(MOTION)), static=True)
        send(f"action/{kind}", rr.Scalars.columns(scalars=getattr(seen, kind).astype(float)), frames[1:])
    send("gripper/opening", rr.Scalars.columns(scalars=seen.opening.astype(float)))
    recording.flush()
    recording.disconnect()


def _plain(value: Any) -> str | float:
    return value if isinstance(value, str | int | float) else json.dumps(value, default=str)


def _as_jpeg(frame: NDArray[np.uint8]) -> bytes:
    content = BytesIO()
    Image.fromarray(frame).save(content, "JPEG", quality=JPEG_QUALITY)
    return content.getvalue()
