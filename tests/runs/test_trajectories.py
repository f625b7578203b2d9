"""Trajectories: stored with every episode, protected like the rest, and loaded."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import zarr

from probe_kit.errors import RunDamagedError, UsageError
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.runs import Run, arrays, open_run, verify_run
from tests.support.rehashing import rehash


@pytest.fixture
def copy(recorded_run: Run, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded_run.path, tmp_path / "run"))


def test_every_episode_keeps_its_trajectory(recorded_run: Run) -> None:
    episodes = recorded_run.episodes
    assert len(recorded_run.trajectories) == len(episodes)
    for position, trajectory in enumerate(recorded_run.trajectories):
        row = episodes.iloc[position]
        assert trajectory.steps == row["steps"] == 4
        np.testing.assert_allclose(trajectory.cube[-1, :2], (row["cube_x"], row["cube_y"]), atol=1e-6)
        assert trajectory.held[-1] == row["is_grasped"]
        assert np.isfinite(trajectory.frames[1:]).all()
    last = str(episodes["episode_id"].iloc[-1])
    np.testing.assert_array_equal(recorded_run.trajectory(last).frames, recorded_run.trajectory(47).frames)


def test_a_trajectory_takes_a_few_kilobytes(recorded_run: Run) -> None:
    for commit in recorded_run.commits():
        sizes = [size for key, (size, *_) in commit.objects.items() if key.startswith("trajectory/")]
        assert len(sizes) == 1
        assert sizes[0] < 4000


def test_the_instruction_is_kept_as_the_policy_was_delivered_it(recorded_run: Run, pi0_tiny: Pi0) -> None:
    for position, instruction in enumerate(recorded_run.episodes["instruction"]):
        tokens, mask = pi0_tiny.tokenise([instruction])
        assert recorded_run.instruction_ids(position) == tuple(tokens[0][mask[0]].tolist())


def test_an_episode_that_is_not_there_is_named(recorded_run: Run) -> None:
    for episode in ("color-9999:o", 48, -1):
        with pytest.raises(UsageError, match="48, from 'a2a"):
            recorded_run.trajectory(episode)


def test_a_changed_bit_is_found_on_reading_and_by_verification(copy: Path) -> None:
    chunk = copy / "data.zarr/trajectory/c/3/0/0"
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    run = open_run(copy)
    run.trajectory(2)
    with pytest.raises(RunDamagedError, match=r"trajectory/c/3/0/0 has other bytes"):
        run.trajectory(3)
    problems = verify_run(copy, deep=True).problems
    assert any("trajectory/c/3/0/0" in problem for problem in problems)


@pytest.mark.parametrize("together", [1, 5, 99])
def test_trajectories_that_are_read_together_are_those_that_are_read_alone(
    recorded_run: Run, copy: Path, monkeypatch: pytest.MonkeyPatch, together: int
) -> None:
    array = zarr.open_array(str(copy / "data.zarr"), path="trajectory", mode="r")
    monkeypatch.setattr(arrays, "_BLOCK_BYTES", together * array[0].nbytes)
    assert len(list(recorded_run.trajectories)) == 48
    for position, trajectory in enumerate(recorded_run.trajectories):
        np.testing.assert_array_equal(trajectory.frames, recorded_run.trajectories[position].frames)
    chunk = copy / "data.zarr/trajectory/c/17/0/0"
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"x")
    reading = iter(open_run(copy).trajectories)
    assert [next(reading).steps for _ in range(17)] == [4] * 17
    with pytest.raises(RunDamagedError, match="trajectory/c/17/0/0"):
        next(reading)


def test_channels_of_another_version_are_refused(copy: Path) -> None:
    array = zarr.open_array(copy / "data.zarr/trajectory", mode="r+")
    array.attrs["channels"] = [str(name).replace("held", "grip") for name in array.attrs["channels"]]
    with pytest.raises(RunDamagedError, match=r"trajectory/zarr\.json has"):
        open_run(copy)
    rehash(copy)
    with pytest.raises(RunDamagedError, match=r"lack held\.bool"):
        _ = open_run(copy).trajectories
