"""A run in the scene, exported as a LeRobotDataset, is shown to its own policy again."""

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from probe_kit.env import SceneSpec
from probe_kit.errors import SuiteError, UsageError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.extract.sources.recording import LeRobotSource
from probe_kit.runs import Run, export_run
from probe_kit.suite import Suite
from tests.support.acting_checkpoints import FAMILIES

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="module")
def exported(recorded_run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("datasets", reason="the extra `datasets` is not installed")
    return export_run(recorded_run.path, "lerobot", tmp_path_factory.mktemp("exported") / "data")


@pytest.mark.slow
def test_lerobot_loads_the_data_set_with_the_runs_numbers(recorded_run: Run, exported: Path) -> None:
    datasets = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="lerobot's data sets lack a library")
    data = datasets.LeRobotDataset("probe_kit/run", root=exported)
    steps = [recorded_run.trajectory(number).steps for number in range(len(recorded_run.episodes))]
    assert (data.num_episodes, data.num_frames, data.fps) == (len(steps), sum(steps), 5)
    first = 0
    for number, count in enumerate(steps):
        trajectory = recorded_run.trajectory(number)
        for step in range(count):
            row = data[first + step]
            assert (int(row["episode_index"]), int(row["frame_index"])) == (number, step)
            np.testing.assert_array_equal(row["action"].numpy(), trajectory.commanded[step])
            state = np.array([*trajectory.tool[step], 0, trajectory.opening[step]], np.float32)
            np.testing.assert_array_equal(row["observation.state"].numpy(), state)
            assert row["task"] == recorded_run.episodes["instruction"].iloc[number]
        first += count
    with (exported / "meta" / "probe_kit_episodes.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["outcome"] for row in rows] == recorded_run.episodes["outcome"].tolist()
    assert [row["episode_index"] for row in rows] == [str(number) for number in range(len(steps))]


def backbone_of(run: Run, row: int, call: int = 0) -> NDArray[np.float32]:
    site, view = run.sites("backbone")[-1], run.views("backbone")[0]
    return run.column(site, view, call=call)[row]


@pytest.mark.slow
def test_the_policy_of_a_run_sees_in_the_export_what_it_saw_at_every_inference(
    small_suite: Suite, tmp_path: Path
) -> None:
    pytest.importorskip("datasets", reason="the extra `datasets` is not installed")
    scene = {"suite": small_suite.folder, "categories": ("color",), "items": 2, "max_steps": 5}
    played = extract_run(ExtractSettings("pi0-tiny", **scene, execute=2, captured_calls=3), tmp_path / "played")
    data = export_run(played.path, "lerobot", tmp_path / "data")
    source = LeRobotSource(str(data), every=2)
    replayed = extract_run(ExtractSettings("pi0-tiny", source=source), tmp_path / "shown")
    for row, number in enumerate(replayed.episodes["source_episode"]):
        for call in range(3):
            np.testing.assert_array_equal(backbone_of(replayed, row, call), backbone_of(played, number, call))


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_every_policy_sees_in_the_export_what_it_sees_in_the_scene(
    family: str, recorded_run: Run, exported: Path, small_suite: Suite, tmp_path: Path
) -> None:
    category = {"categories": ("color",), "items": 6}
    tiny, few = FAMILIES[family], small_suite.select(category["categories"], category["items"])
    common = {
        "model": family,
        "checkpoint": tiny.prepare_checkpoint(few, tmp_path / "tiny"),
        "options": tiny.options,
    }
    in_scene = ExtractSettings(
        **common,
        **category,
        suite=small_suite.folder,
        scene=SceneSpec(max_steps=4),
        capture_only=True,
        accept_units=True,
    )
    scene = extract_run(in_scene, tmp_path / "scene")
    camera = scene.certificate["policy"]["cameras"][0]
    cameras = [f"{camera}=observation.images.scene"]
    source = LeRobotSource(str(exported), every=100, episodes=f"0:{len(scene.episodes)}", cameras=cameras)
    replayed = extract_run(ExtractSettings(**common, source=source, accept_units=True), tmp_path / "shown")
    items = recorded_run.episodes["item_id"].tolist()
    assert scene.episodes["item_id"].tolist() == items[: len(scene.episodes)]
    for row, number in enumerate(replayed.episodes["source_episode"]):
        np.testing.assert_array_equal(backbone_of(replayed, row), backbone_of(scene, number))


@pytest.mark.slow
def test_an_export_that_cannot_draw_the_same_pictures_is_refused(
    recorded_run: Run, small_suite: Suite, tmp_path: Path
) -> None:
    other = Path(shutil.copytree(small_suite.folder, tmp_path / "suite"))
    for picture in other.rglob("*.png"):
        picture.write_bytes(next(iter(sorted(other.rglob("*.png")))).read_bytes())
    with pytest.raises(SuiteError):
        export_run(recorded_run.path, "lerobot", tmp_path / "data", suite=other)
    assert not (tmp_path / "data").exists()
    with pytest.raises(UsageError, match="--suite"):
        export_run(recorded_run.path, "h5", tmp_path / "data.h5", suite=other)
