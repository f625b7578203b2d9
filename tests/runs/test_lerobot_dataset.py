"""A LeRobotDataset of a run is one that lerobot itself loads, with the run's numbers."""

import csv
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.runs import Run, export_run, open_run
from probe_kit.runs.store import locate
from probe_kit.runs.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.suite import Suite
from tests.support.little_run import STEPS, episode, little_plan, little_writer, write_little_run

EPISODES = 2


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


def test_a_run_without_all_frames_has_no_data_set(small_suite: Suite, tmp_path: Path) -> None:
    run = write_little_run(tmp_path / "run", small_suite, episodes=EPISODES)
    with pytest.raises(UsageError, match="with --frames all"):
        export_run(run.path, "lerobot", tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_lerobot_loads_the_data_set_with_the_runs_numbers(filmed: Run, tmp_path: Path) -> None:
    datasets = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="lerobot's data sets lack a library")
    root = export_run(filmed.path, "lerobot", tmp_path / "data")
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
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
