"""What the meta of a data set claims is bounded before room is made for it; each refusal names the file."""

import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from probe_kit.errors import RecordingError
from probe_kit.extract.sources.lerobot_folder import LeRobotFolder
from probe_kit.extract.sources.lerobot_meta import LeRobotMeta

STATE, CAMERA = "observation.state", "observation.images.top"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The meta of two episodes of three frames, in the columns that lerobot writes."""
    root = tmp_path_factory.mktemp("foreign") / "rec"
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.table({"task_index": [0], "task": ["Put the cube"]}), root / "meta/tasks.parquet")
    episodes = {
        "episode_index": [0, 1], "length": [3, 3], "dataset_from_index": [0, 3], "dataset_to_index": [3, 6],
        "data/chunk_index": [0, 0], "data/file_index": [0, 0],
        f"videos/{CAMERA}/chunk_index": [0, 0], f"videos/{CAMERA}/file_index": [0, 0],
        f"videos/{CAMERA}/from_timestamp": [0.0, 0.3], f"videos/{CAMERA}/to_timestamp": [0.3, 0.6],
    }  # fmt: skip
    pq.write_table(pa.table(episodes), root / "meta/episodes/chunk-000/file-000.parquet")
    content = {
        "codebase_version": "v3.0", "fps": 10, "total_episodes": 2, "total_frames": 6, "total_tasks": 1,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": {
            STATE: {"dtype": "float32", "shape": [8], "names": None},
            CAMERA: {"dtype": "video", "shape": [48, 64, 3], "names": ["height", "width", "channels"],
                     "info": {"video.fps": 10}},
            "note": {"dtype": "string", "shape": [1], "names": None},
            "reward": {"dtype": "float32", "shape": [1], "names": None},
        },
    }  # fmt: skip
    (root / "meta/info.json").write_text(json.dumps(content), encoding="utf-8")
    return root


def test_the_meta_as_lerobot_writes_it_is_read(written: Path) -> None:
    meta = LeRobotMeta.read(written)
    assert [str(episode.file) for episode in meta.episodes] == ["data/chunk-000/file-000.parquet"] * 2
    assert str(meta.episodes[1].videos[CAMERA].file) == f"videos/{CAMERA}/chunk-000/file-000.mp4"


def of(*path: str, value: Any) -> tuple[tuple[str, ...], Any]:
    return path, value


@pytest.mark.parametrize(
    ("path", "value"),
    [
        *(of("features", name, "shape", value=shape)
          for name in (STATE, CAMERA, "note", "reward")
          for shape in ([10**12], [], [-1], [2] * 40, [10**6] * 3, [10**1000], "8", None, {})),
        of("features", CAMERA, "shape", value=[48, 8193, 3]),
        of("features", CAMERA, "shape", value=[0, 64, 3]),
        *(of("features", CAMERA, part, value=value) for part in ("info", "video_info") for value in ([1], "x", 7)),
        of("features", CAMERA, "info", "video.fps", value=10**400),
        of("features", value=[]),
        *(of("fps", value=value) for value in (10**400, 1e300, 1e-300, 10**7, "10", True, None, [])),
        *(of(template, value=value)
          for template in ("data_path", "video_path")
          for value in ("{chunk_index:099999999d}", "{chunk_index:99999999}", "{chunk_index:{file_index}d}",
                        "{chunk_index:\u0663\u0663\u0663d}", "{chunk_index.__class__}", "{chunk_index!r:>999}",
                        "{0}", "x" * 2000, "data\0/x", "data/\x1b[2J", "../x", "/x", 7, None, [])),
        *(of("total_episodes", value=value) for value in (10**12, "2", 2.5, [], None)),
        of("total_frames", value=10**400),
        of("codebase_version", value="v" + "9" * 5000 + ".0"),
    ],
    ids=lambda part: ".".join(part)[-30:] if isinstance(part, tuple) else repr(part)[:30],
)  # fmt: skip
def test_a_claim_that_no_data_set_has_is_refused_by_name(
    written: Path, tmp_path: Path, path: tuple[str, ...], value: Any
) -> None:
    root = Path(shutil.copytree(written, tmp_path / "rec"))
    info = json.loads((root / "meta/info.json").read_bytes())
    holder = info
    for name in path[:-1]:
        holder = holder[name]
    holder[path[-1]] = value
    (root / "meta/info.json").write_text(json.dumps(info), encoding="utf-8")
    with pytest.raises(RecordingError, match=r"^rec") as refused:
        LeRobotMeta.read(root)
    assert len(str(refused.value)) < 800
    assert "meta/" in str(refused.value)


def test_a_state_of_more_numbers_than_any_robot_has_is_refused_where_it_is_used(
    written: Path, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(written, tmp_path / "rec"))
    info = json.loads((root / "meta/info.json").read_bytes())
    info["features"][STATE]["shape"] = [1 << 20]
    (root / "meta/info.json").write_text(json.dumps(info), encoding="utf-8")
    with pytest.raises(RecordingError, match=r"observation.state 1,048,576 numbers; expected at most 65,536"):
        LeRobotFolder.read(root).width(STATE)


def test_a_state_of_no_numbers_is_no_state(written: Path, tmp_path: Path) -> None:
    """Else a run would store an array of length 0, which Zarr refuses."""
    root = Path(shutil.copytree(written, tmp_path / "rec"))
    info = json.loads((root / "meta/info.json").read_bytes())
    info["features"][STATE]["shape"] = [0]
    (root / "meta/info.json").write_text(json.dumps(info), encoding="utf-8")
    folder = LeRobotFolder.read(root)
    assert folder.width(STATE) is None
    assert folder.names(STATE) == []


def test_episodes_of_more_frames_than_a_recording_has_are_refused(written: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(written, tmp_path / "rec"))
    file = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(file).to_pydict()
    for name, numbers in (
        ("length", [10**15, 3]), ("dataset_from_index", [0, 10**15]), ("dataset_to_index", [10**15, 10**15 + 3]),
    ):  # fmt: skip
        table[name] = numbers
    pq.write_table(pa.table(table), file)
    with pytest.raises(RecordingError, match=r"1000000000000000 frames; expected at most"):
        LeRobotMeta.read(root)
