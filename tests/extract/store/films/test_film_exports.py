"""Films of a run play every stored frame, and a LeRobotDataset of it is one that lerobot itself loads."""

import csv
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from probe_kit.errors import UsageError
from probe_kit.extract import Run, export_run, open_run
from probe_kit.extract.store.locations.locate import locate
from probe_kit.extract.store.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.suite import Suite
from tests.support.little_run import STEPS, episode, little_plan, little_writer, write_little_run

EPISODES = 2
NO_RERUN = "the SDK of rerun is not installed (extra rerun)"


def frames_of(number: int) -> tuple[NDArray[np.uint8], ...]:
    """One before the first action and one behind each, of different greys; an odd width."""
    return tuple(np.full((60, 81, 3), 100 * number + 40 * step, np.uint8) for step in range(STEPS + 1))


@pytest.fixture(scope="module")
def filmed(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Run:
    plan = little_plan(small_suite, episodes=EPISODES)
    writer = little_writer(locate(tmp_path_factory.mktemp("filmed") / "run"), plan)
    for number in range(EPISODES):
        frames = frames_of(number)
        pictures = {thumbnail_key(number): as_thumbnail(frames, "all")}
        writer.write(replace(episode(plan, number), pictures=pictures, frames=len(frames)))
    return open_run(writer.location)


def test_a_film_has_every_frame_at_the_rate_of_control(filmed: Run, tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="PyAV is not installed")
    folder = export_run(filmed.path, "mp4", tmp_path / "films")
    rows = filmed.episodes.to_dict("records")
    names = [f"{row['episode']:08d}-{row['category']}-{row['outcome']}.mp4" for row in rows]
    assert sorted(path.name for path in folder.iterdir()) == [*names, "SHA256SUMS"]
    for number, name in enumerate(names):
        with av.open(str(folder / name)) as film:
            assert film.streams.video[0].average_rate == 5
            shown = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
        for seen, frame in zip(shown, frames_of(number), strict=True):
            assert seen.shape == (60, 80, 3)
            assert abs(float(seen.mean()) - frame.mean()) < 6


@pytest.mark.parametrize("style", ["mp4", "lerobot", "rerun"])
def test_a_run_without_all_frames_has_no_film(small_suite: Suite, tmp_path: Path, style: str) -> None:
    if style == "rerun":
        pytest.importorskip("rerun", reason=NO_RERUN)
    run = write_little_run(tmp_path / "run", small_suite, episodes=EPISODES)
    with pytest.raises(UsageError, match="with --frames all"):
        export_run(run.path, style, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.filterwarnings("ignore")
def test_a_recording_of_rerun_has_frames_poses_and_actions_at_their_steps(filmed: Run, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason=NO_RERUN)
    folder = export_run(filmed.path, "rerun", tmp_path / "recordings")
    rows = filmed.episodes.to_dict("records")
    names = [f"{row['episode']:08d}-{row['category']}-{row['outcome']}.rrd" for row in rows]
    assert sorted(path.name for path in folder.glob("*.rrd")) == names
    for number, name in enumerate(names):
        found, seen = recorded(folder / name), filmed.trajectory(number)
        expected = {
            "/scene/tool Points3D:positions": seen.tool[:, :3],
            "/scene/cube Transform3D:translation": seen.cube[:, :3],
            "/scene/cube Transform3D:quaternion": seen.cube[:, 3:],
            "/scene/tile_right Transform3D:translation": seen.tile_right[:, :3],
            "/gripper/opening Scalars:scalars": seen.opening,
            "/action/commanded Scalars:scalars": seen.commanded,
            "/action/executed Scalars:scalars": seen.executed,
        }
        for place, values in expected.items():
            steps, read = found[place]
            assert steps == list(range(STEPS + 1))[-len(values) :], place
            np.testing.assert_array_equal(np.float32(read), values)
        steps, pictures = found["/camera EncodedImage:blob"]
        assert steps == list(range(STEPS + 1))
        for picture, frame in zip(pictures, frames_of(number), strict=True):
            with Image.open(BytesIO(bytes(picture))) as one:
                assert abs(float(np.asarray(one.convert("RGB")).mean()) - frame.mean()) < 6
        assert found["/instruction TextDocument:text"][1] == [rows[number]["instruction"]]
        for column in ("outcome", "steps", "scene_seed", "cube_x"):
            assert found[f"/__properties/episode {column}"][1] == [rows[number][column]]


def recorded(path: Path) -> dict[str, tuple[list[int], list[Any]]]:
    """By entity and component, steps and values of a recording, as rerun itself reads it."""
    reader = pytest.importorskip("rerun.chunk", reason=NO_RERUN).RrdReader
    found: dict[str, tuple[list[int], list[Any]]] = {}
    for chunk in reader(str(path)).stream():
        batch = chunk.to_record_batch()
        steps = batch["step"].to_pylist() if "step" in batch.schema.names else []
        for column in set(batch.schema.names) - {"step", "seconds", "rerun.controls.RowId"}:
            values = [value[0] if len(value) == 1 else value for value in batch[column].to_pylist()]
            found[f"{chunk.entity_path} {column}"] = steps, values
    return found


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_lerobot_loads_the_data_set_with_the_runs_numbers(filmed: Run, tmp_path: Path) -> None:
    datasets = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="lerobot's data sets lack a library")
    root = export_run(filmed.path, "lerobot", tmp_path / "data")
    data = datasets.LeRobotDataset("probe_kit/run", root=root, video_backend="pyav")
    assert (data.num_episodes, data.num_frames, data.fps) == (EPISODES, EPISODES * STEPS, 5)
    for number in range(EPISODES):
        trajectory = filmed.trajectory(number)
        for step in range(STEPS):
            row = data[number * STEPS + step]
            assert (int(row["episode_index"]), int(row["frame_index"])) == (number, step)
            np.testing.assert_array_equal(row["action"].numpy(), trajectory.commanded[step])
            np.testing.assert_array_equal(row["observation.state"].numpy()[:6], trajectory.tool[step])
            assert float(row["observation.state"][6]) == trajectory.opening[step]
            assert row["task"] == filmed.episodes["instruction"].iloc[number]
            picture = row["observation.images.scene"].numpy()
            assert picture.shape[0] == 3
            assert abs(255 * float(picture.mean()) - frames_of(number)[step].mean()) < 6
    with (root / "meta" / "probe_kit_episodes.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["outcome"] for row in rows] == filmed.episodes["outcome"].tolist()
    assert [row["episode_index"] for row in rows] == ["0", "1"]
