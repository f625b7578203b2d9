"""Recordings that lerobot wrote, from the folder to the stored activations, and every trap on the way."""

import json
import shutil
import socket
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from probe_kit.diagnose.diagnosis import with_units
from probe_kit.diagnose.results import InputDiagnosis
from probe_kit.env import SceneSpec
from probe_kit.errors import RecordingError, SettingsMismatchError, UnitsError, UsageError
from probe_kit.extract import ExtractSettings, LeRobotSource, extract_run, prepare
from probe_kit.extract.rollout.controllers import PolicyController, Turn
from probe_kit.extract.sources.lerobot_folder import LeRobotFrames, open_lerobot
from probe_kit.extract.sources.player import SIDE
from probe_kit.extract.sources.recording_source import RecordingSource
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.runs import Run, compare_actions, verify_run
from probe_kit.runs.plan import Row
from probe_kit.suite import Suite
from tests.extract.recordings.conftest import STATE, observations
from tests.support.lerobot_recordings import CAMERA, write_recording

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("_lerobot_cache")]


def settings(folder: Path, **source: Any) -> ExtractSettings:
    accept = source.pop("accept_units", False)
    return ExtractSettings(
        "pi0-tiny", source=LeRobotSource(str(folder), **source), env_workers=0, accept_units=accept
    )


def extract_recording(folder: Path, out: Path, policy: Pi0, **source: Any) -> Run:
    return prepare(settings(folder, **source), out, model=policy).run(out)


def rows(run: Run) -> dict[str, np.ndarray]:
    """(E, C, …) pooled rows of every stream."""
    return {name: np.stack([run.rows(name)[row] for row in range(len(run.episodes))]) for name in run.streams}


@pytest.fixture(scope="module")
def run(recording: Path, pi0_tiny: Pi0, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return extract_recording(recording, tmp_path_factory.mktemp("shown") / "run", pi0_tiny)


# -- the acceptance -------------------------------------------------------------------------------------------


def test_a_data_set_written_from_a_scene_run_gives_that_runs_activations_bit_for_bit(
    small_suite: Suite, pi0_tiny: Pi0, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pictures of 640 × 480 as PNG, batch 1, the seeds of the scene run."""
    observations_by_seed: dict[int, list[Observation]] = {}
    infer = PolicyController.infer

    def watched(controller: PolicyController, turns: list[Turn]) -> Any:
        for turn in turns:
            observations_by_seed.setdefault(turn.row.policy_seed, []).append(turn.observation)
        return infer(controller, turns)

    monkeypatch.setattr(PolicyController, "infer", watched)
    scene = ExtractSettings(
        "pi0-tiny", suite=small_suite.folder, categories=("color",), items=2, scene=SceneSpec(max_steps=6),
        captured_calls=3, execute=2, env_workers=0,
    )  # fmt: skip
    prepared = prepare(scene, model=pi0_tiny)
    acted = prepared.run(tmp_path / "scene")
    monkeypatch.setattr(PolicyController, "infer", infer)
    seeds = [int(seed) for seed in acted.episodes["policy_seed"]]
    folder = write_recording(tmp_path / "rec", [observations_by_seed[seed] for seed in seeds])

    again = prepare(settings(folder), model=pi0_tiny)
    stretches = tuple(
        replace(row, columns={**row.columns, "policy_seed": seed})
        for row, seed in zip(again.plan.episodes, seeds, strict=True)
    )
    replayed = replace(again, plan=replace(again.plan, episodes=stretches)).run(tmp_path / "run")
    ours, theirs = rows(replayed), rows(acted)
    assert ours.keys() == theirs.keys()
    for name, values in theirs.items():
        assert np.isfinite(values).all()
        np.testing.assert_array_equal(ours[name], values)
    assert replayed.inputs is not None
    np.testing.assert_array_equal(replayed.inputs.read("state")[0, 0], observations_by_seed[seeds[0]][0].state)
    check = replayed.certificate["capture_check"]
    assert replayed.certificate["hooks_on_equals_hooks_off"], check


# -- what is stored -------------------------------------------------------------------------------------------


def test_states_actions_and_columns_are_the_recorded_ones(run: Run) -> None:
    assert verify_run(run.path, deep=True).ok
    assert run.inputs is not None
    states, actions, reward = run.inputs.read("state"), run.inputs.read("action"), run.inputs.column("next.reward")
    expected = observations()
    for row, episode in enumerate(expected):
        np.testing.assert_array_equal(states[row, : len(episode)], [observation.state for observation in episode])
        np.testing.assert_array_equal(actions[row, : len(episode), 0, 0], 10 * row + np.arange(len(episode)))
        np.testing.assert_array_equal(reward[row, : len(episode)], np.arange(len(episode)) >= 3)
        assert np.isnan(actions[row, len(episode) - 1, 1:]).all(), "nothing was recorded behind the end"
    assert run.inputs.read("prediction").shape == (3, 7, 16, 7)
    assert list(run.control_steps[0]) == [0, 1, 2, 3, 4, -1, -1]
    assert set(run.episodes["outcome"]) == {"capture_only"}
    assert list(run.episodes["instruction"])[:2] == [
        expected_episode[0].instruction for expected_episode in expected[:2]
    ]


def test_predictions_are_what_the_policy_acts_in_a_scene(run: Run, pi0_tiny: Pi0) -> None:
    """Of the embedded policy, whose own units are those of the arm. A batch of three rounds otherwise than one."""
    assert run.inputs is not None
    seed = int(run.episodes["policy_seed"].iloc[0])
    first, row = observations()[0][0], Row(0, {"policy_seed": seed}, frames=(0,))
    acted = pi0_tiny.act([first], [Turn(first, row, 0, None).derived_seed("inference")])  # type: ignore[arg-type]
    np.testing.assert_allclose(run.inputs.read("prediction")[0, 0], acted[0], rtol=0, atol=1e-6)


def test_predicted_actions_are_compared_with_recorded_ones_in_their_units(run: Run) -> None:
    """Recorded actions are 10 × episode + frame, far outside what the policy was trained on."""
    assert run.settings["recording"]["other_actions"].startswith("recorded actions do not fit the statistics")
    with pytest.raises(UsageError, match="not compared: recorded actions do not fit"):
        compare_actions(run)


def test_actions_within_the_statistics_are_compared(pi0_tiny: Pi0, tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "rec", observations(1, 4))
    action = np.array([0.001, 0.002, 0.003, 0, 0, 0, 1], np.float32)
    rewrite(folder, lambda table: table.assign(action=[action] * len(table)))
    replayed = extract_recording(folder, tmp_path / "run", pi0_tiny)
    errors = compare_actions(replayed)
    assert replayed.inputs is not None
    predicted = replayed.inputs.read("prediction")[0, :, 0]
    np.testing.assert_allclose(errors.errors[0, :4, 0], predicted[:4] - action, atol=1e-6)
    assert np.isnan(errors.by_number["first"]).all(), "constant numbers have no deviation to count in"


def test_actions_of_another_count_are_not_compared(pi0_tiny: Pi0, tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "rec", observations(1, 2), actions=6)
    with pytest.raises(UsageError, match="the policy predicts 7 numbers, the data set has 6"):
        compare_actions(extract_recording(folder, tmp_path / "run", pi0_tiny))


def test_pictures_leave_lerobot_as_the_bytes_that_were_written(recording: Path) -> None:
    folder = open_lerobot(LeRobotSource(str(recording)))
    frames = LeRobotFrames(folder)
    for episode, frame in ((2, 6), (0, 0), (1, 3)):
        np.testing.assert_array_equal(
            frames.pictures(episode, frame, [CAMERA])[CAMERA], observations()[episode][frame].image
        )


def test_no_thumbnails_and_no_pixels_are_kept_where_they_are_not_wanted(
    recording: Path, pi0_tiny: Pi0, tmp_path: Path
) -> None:
    replayed = extract_recording(recording, tmp_path / "run", pi0_tiny, episodes=(0,), every=4, pixels=False)
    assert not (tmp_path / "run" / "frames").exists()
    assert replayed.inputs is not None
    assert "pixels" not in replayed.inputs.kinds
    assert str(recording.parent) not in (tmp_path / "run" / "run.json").read_text(encoding="utf-8")


def test_trap_2_episodes_asked_for_in_another_order_are_not_taken_for_each_other(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """lerobot gives `episodes=[2, 0]` back as 0, 2, and asks the hub where one of a list is not there."""

    def refuse(*_: object) -> None:
        raise AssertionError("the hub was asked")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    frames = LeRobotFrames(open_lerobot(LeRobotSource(str(recording))))
    for episode in (2, 0):
        written = observations()[episode]
        np.testing.assert_array_equal(frames.pictures(episode, 1, [CAMERA])[CAMERA], written[1].image)
        states = frames.numbers(episode, ["observation.state"])["observation.state"]
        np.testing.assert_allclose(states, [observation.state for observation in written])
    for episodes in ((7,), (7, 1)):
        with pytest.raises(RecordingError, match="has 3 episodes, counted from 0; asked for 7"):
            prepare(settings(recording, episodes=episodes))


# -- selection ------------------------------------------------------------------------------------------------


def test_which_frames_and_episodes_are_chosen_changes_no_number_of_a_frame(
    run: Run, recording: Path, pi0_tiny: Pi0, tmp_path: Path
) -> None:
    some = extract_recording(recording, tmp_path / "run", pi0_tiny, episodes=(2, 0), every=2)
    assert list(some.episodes["source_episode"]) == [0, 2], "in the order of the data set"
    for name, every in rows(run).items():
        column = rows(some)[name]
        np.testing.assert_array_equal(column[0, :3], every[0, [0, 2, 4]])
        np.testing.assert_array_equal(column[1, :4], every[2, [0, 2, 4, 6]])


def test_frames_are_decoded_in_child_processes_with_the_same_numbers(
    run: Run, recording: Path, pi0_tiny: Pi0, tmp_path: Path
) -> None:
    worker_settings = settings(recording, episodes=(0, 1)).changed(env_workers=2)
    replayed = prepare(worker_settings, model=pi0_tiny).run(tmp_path / "run")
    for name, every in rows(run).items():
        np.testing.assert_array_equal(rows(replayed)[name][:, :5], every[:2, :5])


def test_a_run_grows_by_further_episodes_of_the_same_data_set(
    recording: Path, pi0_tiny: Pi0, tmp_path: Path
) -> None:
    extract_recording(recording, tmp_path / "run", pi0_tiny, episodes=(1,), every=3)
    grown = extract_recording(recording, tmp_path / "run", pi0_tiny, every=3)
    assert list(grown.episodes["source_episode"]) == [0, 1, 2]
    assert sorted(path.name for path in (tmp_path / "run" / "plan").iterdir()) == [
        "00000000.json",
        "00000001.json",
    ]


def test_the_task_of_a_frame_is_what_the_model_reads(tmp_path: Path) -> None:
    """A row ends where the task changes."""
    words = {(0, frame): "Put the cube on the blue shape" for frame in (3, 4)}
    folder = write_recording(tmp_path / "rec", observations(1), tasks=words)
    plan = prepare(settings(folder)).plan
    assert [(planned.episode_id, planned.instruction.split()[-2]) for planned in plan.episodes] == [
        ("episode-000000", "red"),
        ("episode-000000.1", "blue"),
    ]
    assert [
        planned.instruction
        for planned in prepare(settings(folder, instruction="Put the cube on the star")).plan.episodes
    ] == ["Put the cube on the star"]


def test_rotated_pictures_are_another_run(run: Run, recording: Path, pi0_tiny: Pi0, tmp_path: Path) -> None:
    turned = extract_recording(recording, tmp_path / "run", pi0_tiny, episodes=(0,), rotations={"base": 180})
    assert turned.settings_sha256 != run.settings_sha256
    assert turned.inputs is not None
    picture = Image.fromarray(np.rot90(observations()[0][0].image, 2).copy())
    expected = np.asarray(picture.resize((SIDE, SIDE), Image.Resampling.BOX))
    np.testing.assert_array_equal(turned.inputs.read("pixels")[0, 0, 0], expected)


# -- identity -------------------------------------------------------------------------------------------------


def test_where_the_folder_lies_is_no_part_of_a_run_and_what_it_holds_is(recording: Path, tmp_path: Path) -> None:
    moved = shutil.copytree(recording, tmp_path / "elsewhere")
    original, two = (prepare(settings(folder, episodes=(0,))) for folder in (recording, moved))
    assert original.identity() == two.identity()
    assert original.plan.columns == two.plan.columns
    info = json.loads((moved / "meta" / "info.json").read_text(encoding="utf-8"))
    (moved / "meta" / "info.json").write_text(json.dumps({**info, "robot_type": "other"}), encoding="utf-8")
    assert prepare(settings(moved, episodes=(0,))).identity() != original.identity()


def test_changed_data_of_an_episode_is_not_continued(recording: Path, pi0_tiny: Pi0, tmp_path: Path) -> None:
    moved = shutil.copytree(recording, tmp_path / "rec")
    extract_recording(moved, tmp_path / "run", pi0_tiny, episodes=(0,), every=4)
    rewrite(moved, lambda table: table.assign(**{"next.reward": np.float32(1) - table["next.reward"]}))
    with pytest.raises(SettingsMismatchError, match=r"the files that episode-\d+ shows have changed"):
        extract_recording(moved, tmp_path / "run", pi0_tiny, episodes=(0,), every=4)


# -- traps ----------------------------------------------------------------------------------------------------


def rewrite(folder: Path, change: Any) -> None:
    """Change the data file of a recording as a data frame."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    (file,) = (folder / "data").rglob("*.parquet")
    table = pq.read_table(file)
    pq.write_table(
        pa.Table.from_pandas(change(table.to_pandas()), schema=table.schema, preserve_index=False), file
    )


def test_an_episode_outside_the_data_set_is_refused_and_not_a_warning(recording: Path) -> None:
    with pytest.raises(RecordingError, match="has 3 episodes, counted from 0; asked for 7"):
        prepare(settings(recording, episodes=(1, 7)))


def test_a_missing_file_is_named_and_the_hub_is_not_asked(recording: Path, tmp_path: Path) -> None:
    broken = shutil.copytree(recording, tmp_path / "rec")
    next((broken / "data").rglob("*.parquet")).unlink()
    with pytest.raises(RecordingError, match=r"data/chunk-000/file-000\.parquet of episode 0 is missing"):
        prepare(settings(broken))


@pytest.mark.parametrize("data_path", ["/etc/hostname", "../other/file-{file_index:03d}.parquet"])
def test_files_outside_the_folder_are_refused(recording: Path, tmp_path: Path, data_path: str) -> None:
    moved = shutil.copytree(recording, tmp_path / "rec")
    info = json.loads((moved / "meta" / "info.json").read_text(encoding="utf-8"))
    (moved / "meta" / "info.json").write_text(json.dumps({**info, "data_path": data_path}), encoding="utf-8")
    with pytest.raises(RecordingError, match="for episode 0; expected a file in the data set's folder"):
        prepare(settings(moved))


def test_tasks_are_named_by_their_number_wherever_their_line_is(recording: Path, tmp_path: Path) -> None:
    """lerobot writes them in order; a table that was edited may have another one."""
    moved = shutil.copytree(recording, tmp_path / "rec")
    tasks = pd.read_parquet(moved / "meta" / "tasks.parquet")
    tasks.iloc[::-1].to_parquet(moved / "meta" / "tasks.parquet")
    texts = [
        [stretch.instruction for stretch in prepare(settings(folder)).plan.episodes]
        for folder in (recording, moved)
    ]  # type: ignore[union-attr]
    assert texts[0] == texts[1]
    rewrite(moved, lambda table: table.assign(task_index=np.int64(-1)))
    with pytest.raises(RecordingError, match="has 0 tasks of the number -1"):
        prepare(settings(moved))
    (moved / "meta" / "tasks.parquet").unlink()
    with pytest.raises(RecordingError, match=r"rec has no meta/tasks\.parquet"):
        prepare(settings(moved))


def test_data_that_lacks_an_episode_that_its_meta_names_is_refused(recording: Path, tmp_path: Path) -> None:
    broken = shutil.copytree(recording, tmp_path / "rec")
    rewrite(broken, lambda table: table[table["episode_index"] != 1])
    with pytest.raises(
        RecordingError,
        match=r"rec: data/chunk-000/file-000\.parquet holds 0 frames of episode 1; meta/episodes says 6",
    ):
        prepare(settings(broken))


def test_timestamps_off_the_grid_are_refused_with_their_frame(recording: Path, tmp_path: Path) -> None:
    broken = shutil.copytree(recording, tmp_path / "rec")
    late = np.float32(0.07)
    rewrite(broken, lambda table: table.assign(timestamp=table["timestamp"] + late * (table["index"] == 8)))
    with pytest.raises(
        RecordingError, match=r"episode 1: line 3 is frame 3 at 0\.6700 s; expected frame 3 at 0\.6"
    ):
        prepare(settings(broken))


def test_a_state_of_another_robot_is_refused(tmp_path: Path) -> None:
    other = [
        [replace(observation, state=observation.state[:6]) for observation in episode]
        for episode in observations(1)
    ]
    folder = write_recording(tmp_path / "rec", other)
    with pytest.raises(RecordingError, match=r"6 numbers as observation\.state; pi0-tiny reads 8"):
        prepare(settings(folder))


def test_states_far_outside_the_checkpoints_statistics_are_refused_unless_accepted(
    pi0_tiny: Pi0, tmp_path: Path
) -> None:
    """Millimetres where the checkpoint reads metres; its own statistics decide, never those of the data set."""
    scale = np.array([1000, 1000, 1000, 1, 1, 1, 1, 1], np.float32)
    other = [
        [replace(observation, state=observation.state * scale) for observation in episode]
        for episode in observations(1)
    ]
    folder = write_recording(tmp_path / "rec", other)
    with pytest.raises(UnitsError, match=r"statistics of embedded: s0 \(number 0\).* as millimetres .*--accept-"):
        prepare(settings(folder), model=pi0_tiny)
    accepted = prepare(settings(folder, accept_units=True), model=pi0_tiny).run(tmp_path / "run")
    stored = accepted.settings["units"]["state units"]
    assert (stored["are_other"], stored["are_accepted"]) == (True, True)
    assert "1,000 times larger" in stored["misfits"]
    (state,) = with_units(accepted, [InputDiagnosis("state", "no effect", "")])
    assert state.where.startswith("the loss is in front of the network: s0")


def test_statistics_of_the_data_set_change_nothing(
    run: Run, recording: Path, pi0_tiny: Pi0, tmp_path: Path
) -> None:
    other = shutil.copytree(recording, tmp_path / "rec")
    stats = json.loads((other / "meta" / "stats.json").read_text(encoding="utf-8"))
    stats["observation.state"]["mean"] = (100 + STATE).tolist()
    (other / "meta" / "stats.json").write_text(json.dumps(stats), encoding="utf-8")
    replayed = extract_recording(other, tmp_path / "run", pi0_tiny, episodes=(0,))
    for name, every in rows(run).items():
        np.testing.assert_array_equal(rows(replayed)[name][0], every[0])


def test_a_recording_as_video_says_so_and_gives_nearly_the_numbers_of_its_pictures(
    pi0_tiny: Pi0, tmp_path: Path
) -> None:
    smooth = [
        [replace(observation, image=_smooth(row, frame)) for frame, observation in enumerate(episode)]
        for row, episode in enumerate(observations(2))
    ]
    pictures = extract_recording(write_recording(tmp_path / "png", smooth), tmp_path / "one", pi0_tiny)
    videos = extract_recording(
        write_recording(tmp_path / "video", smooth, videos=True), tmp_path / "two", pi0_tiny
    )
    kinds = [run.settings["dataset"]["cameras"][0][2] for run in (pictures, videos)]
    assert kinds[0] == "image"
    assert kinds[1] != "image"
    (of_pictures,), (of_videos,) = (run.provenances.values() for run in (pictures, videos))
    assert "decoder" not in of_pictures
    assert of_videos["decoder"] == f"PyAV {version('av')}"
    ours, theirs = rows(videos)["backbone"], rows(pictures)["backbone"]
    is_finite = np.isfinite(theirs)
    assert 0 < np.abs(ours[is_finite] - theirs[is_finite]).mean() < 0.1 * np.abs(theirs[is_finite]).mean()


def test_trap_1_videos_are_decoded_without_torchcodec_and_without_a_word(tmp_path: Path) -> None:
    """lerobot prefers torchcodec, which installs without FFmpeg and then fails with pages of log per process."""
    smooth = [
        [replace(observation, image=_smooth(0, frame)) for frame, observation in enumerate(observations(1)[0])]
    ]
    folder = write_recording(tmp_path / "video", smooth, videos=True)
    script = (
        "import sys\n"
        "sys.modules['torchcodec'] = None\n"
        "from probe_kit.extract import LeRobotSource\n"
        "from probe_kit.extract.sources.lerobot_folder import open_lerobot\n"
        "from probe_kit.extract.sources.lerobot_folder import LeRobotFrames\n"
        f"frames = LeRobotFrames(open_lerobot(LeRobotSource({str(folder)!r})))\n"
        f"seen = frames.pictures(0, 3, [{CAMERA!r}])[{CAMERA!r}]\n"
        "print(seen.shape, abs(int(seen[..., 2].mean()) - 60) < 10)\n"
    )
    completed = subprocess.run([sys.executable, "-c", script], capture_output=True, encoding="utf-8", check=False)
    assert completed.stdout.splitlines() == ["(48, 64, 3) True"], completed.stderr
    assert completed.stderr == ""


def test_a_run_of_videos_is_not_continued_with_another_decoder(
    pi0_tiny: Pi0, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_recording(tmp_path / "video", observations(2), videos=True)
    extract_recording(folder, tmp_path / "run", pi0_tiny, episodes=(0,))
    monkeypatch.setattr(RecordingSource, "decoder", "PyAV 1.0")
    with pytest.raises(SettingsMismatchError, match=r"decoder: stored 'PyAV .+', here 'PyAV 1\.0'"):
        extract_recording(folder, tmp_path / "run", pi0_tiny)


def _smooth(row: int, frame: int) -> np.ndarray:
    y, x = np.mgrid[:48, :64]
    return np.stack([2 * y + 5 * row, 2 * x, np.full_like(x, 20 * frame)], axis=2).astype(np.uint8)


def test_an_interrupted_run_continues_with_the_same_bytes(
    run: Run, recording: Path, pi0_tiny: Pi0, tmp_path: Path
) -> None:
    class EnoughError(Exception):
        pass

    def stop(*_: object) -> None:
        raise EnoughError

    with pytest.raises(EnoughError):
        prepare(settings(recording), model=pi0_tiny).run(tmp_path / "run", progress=stop)
    again = prepare(settings(recording), model=pi0_tiny).run(tmp_path / "run")
    assert [commit.objects for commit in again.commits()] == [commit.objects for commit in run.commits()]


def test_the_python_interface_is_that_of_the_command_line(recording: Path, tmp_path: Path) -> None:
    typed = ExtractSettings.of_command(
        {
            "model": "pi0-tiny", "dataset": str(recording), "episodes": "0:2", "select": "every:3",
            "camera": [f"base={CAMERA}"], "env_workers": 0,
        }
    )  # fmt: skip
    assert typed.source == LeRobotSource(str(recording), episodes=range(2), every=3, cameras={"base": CAMERA})
    assert len(extract_run(typed, tmp_path / "run").episodes) == 2
