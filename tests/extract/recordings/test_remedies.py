"""What a message prints is run on the folder for which it is printed, and the folder is then read."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from probe_kit.errors import RecordingError
from probe_kit.extract import LeRobotSource
from probe_kit.extract.sources.lerobot_folder import open_lerobot
from probe_kit.extract.sources.recording_source import RecordingSource
from tests.extract.recordings.conftest import observations
from tests.support.hub_stand_in import hub
from tests.support.lerobot_recordings import write_v21

pytestmark = pytest.mark.usefixtures("_lerobot_cache")
DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
STATE = "observation.state"
OFFLINE = {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[3])}


@pytest.fixture
def copy(recording: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recording, tmp_path / "rec"))


def message(folder: Path | str) -> str:
    with pytest.raises(RecordingError) as refused:
        open_lerobot(LeRobotSource(str(folder)))
    return str(refused.value)


def edit_info(folder: Path, **parts: Any) -> None:
    path = folder / "meta/info.json"
    path.write_text(json.dumps({**json.loads(path.read_text(encoding="utf-8")), **parts}), encoding="utf-8")


def cut(file: Path) -> None:
    """Take the end of a Parquet file, as before it is closed."""
    file.write_bytes(file.read_bytes()[:-200])


def states(folder: Path) -> np.ndarray:
    source = RecordingSource.open(LeRobotSource(str(folder)), False)
    source.check_frames()
    return np.concatenate([source.reader.numbers(episode, [STATE])[STATE] for episode in source.episodes])


WRITTEN = np.concatenate([[observation.state for observation in episode] for episode in observations()])


# -- recordings that ended early ---------------------------------------------------------------------------------


def without_episodes(folder: Path) -> None:
    shutil.rmtree(folder / "meta/episodes")
    cut(folder / DATA)


def with_episodes_cut(folder: Path) -> None:
    cut(folder / EPISODES)
    cut(folder / DATA)


def never_saved(folder: Path) -> None:
    for name in ("data", "meta/episodes"):
        shutil.rmtree(folder / name)
    (folder / "meta/tasks.parquet").unlink()
    edit_info(folder, total_episodes=0, total_frames=0, total_tasks=0)


def never_saved_of_old_format(folder: Path) -> None:
    never_saved(folder)
    edit_info(folder, codebase_version="v2.1")


ENDED: dict[str, tuple[Callable[[Path], None], str]] = {
    "killed": (
        without_episodes,
        r"has total_episodes 3, and meta/episodes none that can be read\. The recording ended before lerobot's "
        rf"finalize\(\) .* Without an end, nothing reads {DATA}\. Record these episodes again",
    ),
    "killed after many episodes": (
        with_episodes_cut,
        rf"nothing reads {DATA}, {EPISODES}\. Record these episodes",
    ),
    "empty": (never_saved, "rec has no episode: .* ended before an episode was saved. Record it again"),
    "empty, of format 2.1": (never_saved_of_old_format, "rec has no episode"),
    "copied without episodes": (
        lambda folder: shutil.rmtree(folder / "meta/episodes"),
        r"^rec has no meta/episodes\. Copy the data set again$",
    ),
}


@pytest.mark.parametrize("kind", ENDED)
def test_a_recording_that_ended_early_is_not_taken_for_a_bad_copy(copy: Path, kind: str) -> None:
    end, expected = ENDED[kind]
    end(copy)
    assert re.search(expected, message(copy))


def continued(folder: Path, episodes_too: bool) -> None:
    """Add what a second recording of two episodes leaves, if it is killed."""
    for name in (DATA, EPISODES)[: 1 + episodes_too]:
        other = folder / name.replace("file-000", "file-001")
        shutil.copy(folder / name, other)
        cut(other)
    edit_info(folder, total_episodes=5, total_frames=30)


def follow(folder: Path, text: str) -> None:
    """Do what a message about a continued recording says."""
    moved = re.search(r"move (\S+(?:, \S+)*) out of the data set", text)
    totals = dict(re.findall(r"(total_\w+) (\d+)", text.rpartition("and write ")[2]))
    assert moved is not None
    for name in moved[1].split(", "):
        (folder / name).rename(folder.parent / Path(name).name)
    edit_info(folder, **{name: int(count) for name, count in totals.items()})


@pytest.mark.parametrize("episodes_too", [False, True])
def test_the_whole_episodes_of_a_continued_recording_are_kept_as_the_message_says(
    copy: Path, episodes_too: bool
) -> None:
    continued(copy, episodes_too)
    follow(copy, message(copy))
    np.testing.assert_array_equal(states(copy), WRITTEN)


KILLED = """
import os, sys
from pathlib import Path
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tests.extract.recordings.conftest import observations
from tests.support.lerobot_recordings import CAMERA, add_episodes, write_recording

folder, episodes = Path(sys.argv[1]), int(sys.argv[2])
videos, resumed = (argument == "True" for argument in sys.argv[3:])
finalize = LeRobotDataset.finalize
LeRobotDataset.finalize = lambda self: os._exit(9)
if resumed:
    LeRobotDataset.finalize = finalize
    write_recording(folder, observations(), videos=videos)
    data = LeRobotDataset.resume("local/recording", root=folder)
    add_episodes(data, observations(episodes), 7)
    os._exit(9)
write_recording(folder, observations(episodes), videos=videos)
"""


def killed(folder: Path, *arguments: object) -> None:
    command = [sys.executable, "-c", KILLED, str(folder), *map(str, arguments)]
    completed = subprocess.run(command, capture_output=True, env={**os.environ, **OFFLINE}, check=False)
    assert completed.returncode == 9, completed.stderr[-2000:]


@pytest.mark.slow
@pytest.mark.parametrize("videos", [False, True])
@pytest.mark.parametrize("episodes", [3, 12])
def test_a_recording_that_lerobot_did_not_finalize_is_named_as_one(
    tmp_path: Path, episodes: int, videos: bool
) -> None:
    killed(tmp_path / "rec", episodes, videos, False)
    text = message(tmp_path / "rec")
    assert f"has total_episodes {episodes}" in text
    assert "ended before lerobot's finalize()" in text
    assert ("Their videos lie in videos" in text) == videos


@pytest.mark.slow
@pytest.mark.parametrize("videos", [False, True])
@pytest.mark.parametrize("episodes", [2, 12])
def test_the_episodes_before_a_killed_continuation_are_kept_as_the_message_says(
    tmp_path: Path, episodes: int, videos: bool
) -> None:
    killed(tmp_path / "rec", episodes, videos, True)
    follow(tmp_path / "rec", message(tmp_path / "rec"))
    np.testing.assert_array_equal(states(tmp_path / "rec"), WRITTEN)


# -- older formats -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("version", "expected"),
    [
        ("v2.0", "Only lerobot up to 0.3.3 raises it to v2.1, by convert_dataset_v20_to_v21"),
        ("v1.6", "by convert_dataset_v1_to_v2 and convert_dataset_v20_to_v21"),
        ("v4.0", "has format v4.0, of a later lerobot; .* Update probe_kit"),
        (None, "has the codebase_version None"),
    ],
)
def test_no_command_that_publishes_is_printed_for_other_formats(copy: Path, version: Any, expected: str) -> None:
    edit_info(copy, codebase_version=version)
    text = message(copy)
    assert re.search(expected, text)
    assert "python" not in text


def test_a_folder_of_format_1_is_named_as_one(tmp_path: Path) -> None:
    (tmp_path / "old/meta_data").mkdir(parents=True)
    (tmp_path / "old/meta_data/info.json").write_text('{"codebase_version": "v1.6"}', encoding="utf-8")
    assert "has format v1.x" in message(tmp_path / "old")


def line(text: str) -> str:
    """The command that a message prints."""
    (command,) = re.findall(r"`([^`]+)`", text)
    assert "--push-to-hub=false" in command
    return str(command)


def typed(command: str, folder: Path, **environment: str) -> None:
    """Run a command as typed in a shell, whose working folder is another one."""
    variables = {**os.environ, **OFFLINE, **environment}
    shell = ["bash", "-c", command]
    completed = subprocess.run(
        shell, cwd=folder, env=variables, capture_output=True, text=True, check=False, encoding="utf-8"
    )
    assert completed.returncode == 0, completed.stderr[-2000:]


@pytest.mark.parametrize("taken_suffixes", [(), ("_old",), ("_v30",), ("_old", "_v30")])
def test_the_printed_line_moves_what_the_converter_would_remove(
    copy: Path, taken_suffixes: tuple[str, ...]
) -> None:
    edit_info(copy, codebase_version="v2.1")
    for suffix in taken_suffixes:
        (copy.parent / f"rec{suffix}").mkdir()
    steps = line(message(copy)).split(" && ")
    assert steps[:-1] == [f"mv {copy}{suffix} {copy}{suffix}_1" for suffix in taken_suffixes]
    assert shlex.split(steps[-1])[1:] == [
        "-m", "lerobot.scripts.convert_dataset_v21_to_v30", "--repo-id=local/rec", f"--root={copy}",
        "--push-to-hub=false",
    ]  # fmt: skip


def test_a_path_with_an_apostrophe_is_moved_first(copy: Path) -> None:
    """lerobot's converter writes the path between apostrophes into a list of videos."""
    moved = copy.rename(copy.parent / "it's")
    edit_info(moved, codebase_version="v2.1")
    text = message(moved)
    assert "because of the apostrophe. Move the data set" in text
    assert "`" not in text


@pytest.mark.slow
@pytest.mark.parametrize("videos", [False, True])
@pytest.mark.parametrize("name", ["old", "a folder", "-x;$y"])
def test_the_printed_line_converts_a_folder_of_format_21(tmp_path: Path, name: str, videos: bool) -> None:
    folder = write_v21(tmp_path / "sets" / name, observations(), videos=videos)
    for suffix in ("_old", "_v30"):
        (tmp_path / "sets" / f"{name}{suffix}").mkdir()
        (tmp_path / "sets" / f"{name}{suffix}" / "other").write_text(suffix, encoding="utf-8")
    typed(line(message(folder)), tmp_path)
    np.testing.assert_array_equal(states(folder), WRITTEN)
    contents = {path.read_text(encoding="utf-8") for path in (tmp_path / "sets").glob("*_1/other")}
    assert contents == {"_old", "_v30"}, "the converter removes folders of these names"
    assert (tmp_path / "sets" / f"{name}_old" / "meta/episodes.jsonl").is_file(), "the data set as it was"


@pytest.mark.slow
def test_the_rate_that_the_converter_cuts_is_written_again_as_the_message_says(tmp_path: Path) -> None:
    folder = write_v21(tmp_path / "rec", observations(frames=40), fps=29.97)
    text = message(folder)
    assert "It cuts the fps 29.97 to 29: then write 29.97 into rec/meta/info.json again" in text
    typed(line(text), tmp_path)
    with pytest.raises(RecordingError, match=r"29 frames per second"):
        states(folder)
    edit_info(folder, fps=29.97)
    assert len(states(folder)) == 40 + 41 + 42


@pytest.mark.slow
def test_the_printed_line_downloads_and_converts_a_data_set_of_the_hub(tmp_path: Path) -> None:
    """The cache, in which only its meta is, stays as it was."""
    folder = write_v21(tmp_path / "made", observations())
    commit = "5" * 40
    work = tmp_path / "work"
    work.mkdir()
    with hub() as served:
        paths = [path for path in folder.rglob("*") if path.is_file()]
        served.models["lab/kitchen"] = {commit: {p.relative_to(folder).as_posix(): p.read_bytes() for p in paths}}
        environment = {"HF_ENDPOINT": served.address, "HF_HOME": str(tmp_path / "hf"), "HF_HUB_OFFLINE": "0"}
        show = [str(Path(sys.executable).with_name("probe-kit")), "dataset", "show"]
        refused = subprocess.run(
            [*show, f"lab/kitchen@{commit}"], cwd=work, env={**os.environ, **environment}, capture_output=True,
            text=True, check=False, encoding="utf-8")  # fmt: skip
        text = " ".join(refused.stderr.split())
        assert f"Then give {work / 'kitchen'} in place of lab/kitchen" in text
        typed(line(text), work, **environment)
    np.testing.assert_array_equal(states(work / "kitchen"), WRITTEN)
    assert not [request for request in served.requests if request[0] == "POST"], "nothing was published"


@pytest.mark.slow
def test_the_episodes_that_a_refusal_names_are_read_as_typed(copy: Path) -> None:
    table = pq.read_table(copy / DATA).to_pandas()
    table.loc[table["episode_index"] == 1, "timestamp"] = 0.0
    pd.DataFrame(table).to_parquet(copy / DATA)
    show = [str(Path(sys.executable).with_name("probe-kit")), "dataset", "show", str(copy)]
    refused = subprocess.run(show, capture_output=True, text=True, check=False, encoding="utf-8")
    option = re.search(r"--episodes \S+", refused.stderr)
    assert option is not None, refused.stderr
    subprocess.run([*show, *option[0].split()], capture_output=True, check=True)
