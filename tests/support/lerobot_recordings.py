"""Small LeRobotDatasets, written by lerobot itself."""

import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit._system.machine import same_scheduling
from probe_kit.hooks.contract.observation import Observation

CAMERA = "observation.images.top"
FPS = 5


@same_scheduling()
def write_recording(
    folder: Path,
    episodes: Iterable[Sequence[Observation]],
    actions: int = 7,
    videos: bool = False,
    tasks: Mapping[tuple[int, int], str] | None = None,
    more: Mapping[str, Any] | None = None,
    fps: float = FPS,
) -> Path:
    """What observations hold as a data set of format 3.0: pictures as PNG, states and zero actions.

    videos: encode pictures as video. tasks: of single frames, by episode and frame. more: features beside these,
    with a function of episode and frame.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    episodes = [list(episode) for episode in episodes]
    first = episodes[0][0]
    features: dict[str, Any] = {
        CAMERA: {
            "dtype": "video" if videos else "image",
            "shape": first.image.shape,
            "names": ["height", "width", "channels"],
        },
        "observation.state": {
            "dtype": "float32",
            "shape": first.state.shape,
            "names": [f"s{index}" for index in range(len(first.state))],
        },
        "action": {"dtype": "float32", "shape": (actions,), "names": None},
    }
    extra = dict(more or {})
    features |= {name: {"dtype": "float32", "shape": (1,), "names": None} for name in extra}
    data = LeRobotDataset.create("local/recording", fps, features, root=folder, use_videos=videos)  # type: ignore[arg-type]
    add_episodes(data, episodes, actions, tasks or {}, extra)
    data.finalize()
    return folder


def add_episodes(
    data: Any,
    episodes: Iterable[Sequence[Observation]],
    actions: int = 7,
    tasks: Mapping[tuple[int, int], str] | None = None,
    more: Mapping[str, Any] | None = None,
) -> None:
    """Record episodes, as `write_recording` says."""
    for number, episode in enumerate(episodes):
        for frame, observation in enumerate(episode):
            data.add_frame(
                {
                    CAMERA: observation.image,
                    "observation.state": observation.state,
                    "action": np.full(actions, 10 * number + frame, np.float32),
                    "task": (tasks or {}).get((number, frame), observation.instruction),
                    **{name: np.array([of(number, frame)], np.float32) for name, of in (more or {}).items()},
                }
            )
        data.save_episode()


def write_v21(
    folder: Path, episodes: Iterable[Sequence[Observation]], videos: bool = False, fps: float = FPS
) -> Path:
    """What observations hold as a data set of format 2.1, in which each episode has files of its own.

    The numbers, pictures and statistics are those that lerobot writes; the files are those of lerobot 0.3.3.
    """
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

    (folder / "meta").mkdir(parents=True)
    lines: dict[str, list[dict[str, Any]]] = {"episodes": [], "episodes_stats": [], "tasks": []}
    info: dict[str, Any] = {}
    texts: list[str] = []
    frames = 0
    for number, episode in enumerate(episodes):
        single = write_recording(folder.with_name(f"{folder.name}-{number}"), [episode], videos=videos, fps=fps)
        info = json.loads((single / "meta/info.json").read_text(encoding="utf-8"))
        text = episode[0].instruction
        texts += [text] * (text not in texts)
        (file,) = (single / "data").rglob("*.parquet")
        table = pq.read_table(file)
        columns = {"episode_index": number, "task_index": texts.index(text)}
        cells = {name: [value] * len(episode) for name, value in columns.items()}
        cells["index"] = list(range(frames, frames + len(episode)))
        for name, values in cells.items():
            table = table.set_column(table.schema.get_field_index(name), name, pa.array(values, pa.int64()))
        target = folder / f"data/chunk-000/episode_{number:06d}.parquet"
        target.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, target)
        for video in (single / "videos").rglob("*.mp4"):
            moved = folder / f"videos/chunk-000/{CAMERA}/episode_{number:06d}.mp4"
            moved.parent.mkdir(parents=True, exist_ok=True)
            video.rename(moved)
        (meta,) = pd.read_parquet(single / "meta/episodes").to_dict("records")
        stats: dict[str, dict[str, Any]] = {}
        for key, value in meta.items():
            if str(key).startswith("stats/"):
                feature, _, kind = str(key).removeprefix("stats/").rpartition("/")
                stats.setdefault(feature, {})[kind] = _nested(value)
        lines["episodes"].append({"episode_index": number, "tasks": [text], "length": len(episode)})
        lines["episodes_stats"].append({"episode_index": number, "stats": stats})
        frames += len(episode)
        shutil.rmtree(single)
    lines["tasks"] = [{"task_index": number, "task": text} for number, text in enumerate(texts)]
    for name, rows in lines.items():
        text = "".join(f"{json.dumps(row)}\n" for row in rows)
        (folder / f"meta/{name}.jsonl").write_text(text, encoding="utf-8")
    count = len(lines["episodes"])
    template = "chunk-{episode_chunk:03d}"
    info |= {
        "codebase_version": "v2.1", "total_episodes": count, "total_frames": frames, "total_tasks": len(texts),
        "total_videos": count * videos, "total_chunks": 1, "splits": {"train": f"0:{count}"},
        "data_path": f"data/{template}/episode_{{episode_index:06d}}.parquet",
        "video_path": f"videos/{template}/{{video_key}}/episode_{{episode_index:06d}}.mp4" if videos else None,
    }  # fmt: skip
    (folder / "meta/info.json").write_text(json.dumps(info), encoding="utf-8")
    return folder


def _nested(value: Any) -> Any:
    """Arrays of arrays as lists of lists."""
    return (
        [_nested(part) for part in value]
        if isinstance(value, np.ndarray | list)
        else getattr(value, "item", lambda: value)()
    )
