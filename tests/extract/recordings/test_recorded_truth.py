"""Numbers of a recording are those of the files that are hashed, and meta that contradicts itself is refused."""

import json
import os
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from probe_kit.errors import InstructionError, RecordingError, SettingsMismatchError, UnitsError
from probe_kit.extract import ExtractSettings, LeRobotSource, prepare
from probe_kit.extract.inspect_commands import show_dataset
from probe_kit.extract.sources.lerobot_folder import LeRobotFolder, LeRobotFrames, open_lerobot
from probe_kit.extract.sources.lerobot_meta import HashedFiles
from probe_kit.hooks.families.pi0.adapter import Pi0
from tests.extract.recordings.conftest import observations
from tests.support.lerobot_recordings import CAMERA, FPS, write_recording

pytestmark = pytest.mark.usefixtures("_lerobot_cache")
STATE = "observation.state"
DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture
def copy(recording: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recording, tmp_path / "rec"))


def opened(folder: Path) -> LeRobotFolder:
    return open_lerobot(LeRobotSource(str(folder)))


def shown_states(folder: Path) -> np.ndarray:
    """(frames, 8) of all episodes, as a run reads them."""
    source = opened(folder)
    source.check_files(range(3), [CAMERA])
    frames = LeRobotFrames(source)
    frames.check(range(3), [CAMERA])
    return np.concatenate([frames.numbers(episode, [STATE])[STATE] for episode in range(3)])


def change(file: Path, column: str, of: Callable[[list[Any]], list[Any]], **types: Any) -> None:
    """Rewrite one column of a Parquet file."""
    table = pq.read_table(file)
    column_index = table.schema.get_field_index(column)
    kind = types.get("kind", table.schema.field(column).type)
    cells = pa.array(of(table.column(column).to_pylist()), kind)
    pq.write_table(table.set_column(column_index, pa.field(column, kind), cells), file)


def edit_info(folder: Path, **parts: Any) -> None:
    path = folder / "meta/info.json"
    path.write_text(json.dumps({**json.loads(path.read_text(encoding="utf-8")), **parts}), encoding="utf-8")


WRITTEN = np.concatenate([[observation.state for observation in episode] for episode in observations()])


# -- what is hashed is what is read ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["set[1]", "set?", "se*t", "a{b}", "100%d", "spaß"])
def test_a_folder_is_read_by_its_name_and_never_as_a_pattern(recording: Path, tmp_path: Path, name: str) -> None:
    """`set1` beside it has other states, and fits each of the patterns."""
    folder = Path(shutil.copytree(recording, tmp_path / name))
    other = Path(shutil.copytree(recording, tmp_path / "set1"))
    change(other / DATA, STATE, lambda rows: [[50.0] * 8 for _ in rows])
    np.testing.assert_array_equal(shown_states(folder), WRITTEN)


@pytest.mark.parametrize(
    "file_name", ["data/chunk-000/file-001.parquet", "data/chunk-007/x.parquet", "data/x.parquet"]
)
def test_a_data_file_that_meta_does_not_name_is_refused_by_name(copy: Path, file_name: str) -> None:
    (copy / file_name).parent.mkdir(exist_ok=True)
    shutil.copy(copy / DATA, copy / file_name)
    with pytest.raises(RecordingError, match=f"rec holds {file_name}, in which meta/episodes names no episode"):
        shown_states(copy)


def test_hidden_files_of_other_systems_are_no_data(copy: Path) -> None:
    (copy / "data/chunk-000/._file-000.parquet").write_bytes(b"\0\5\26\7 written by a Mac")
    (copy / "meta/episodes/chunk-000/._file-000.parquet").write_bytes(b"\0\5\26\7 written by a Mac")
    np.testing.assert_array_equal(shown_states(copy), WRITTEN)


def test_a_second_file_of_episodes_is_refused_by_the_doubled_episode(copy: Path) -> None:
    shutil.copy(copy / EPISODES, copy / "meta/episodes/chunk-000/file-001.parquet")
    with pytest.raises(RecordingError, match="meta/episodes has 2 lines of episode 0; expected one"):
        opened(copy)


def replace_same_size(file: Path, content: bytes) -> None:
    """Write other bytes of the same size, and put the time stamp back."""
    before = file.stat()
    assert len(content) == before.st_size
    file.write_bytes(content)
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert (file.stat().st_mtime_ns, file.stat().st_size) == (before.st_mtime_ns, before.st_size)


def plain(folder: Path) -> None:
    """Write the data file anew without compression and checksums, so that bytes of numbers can be changed."""
    table = pq.read_table(folder / DATA)
    pq.write_table(table, folder / DATA, compression="none", use_dictionary=False)


def negated(content: bytes, number: float) -> bytes:
    old = struct.pack("<f", number)
    assert content.count(old) >= 1
    return content.replace(old, struct.pack("<f", -number))


def test_a_file_that_was_replaced_with_its_old_time_stamp_is_read_anew(copy: Path) -> None:
    plain(copy)
    np.testing.assert_array_equal(shown_states(copy), WRITTEN)
    number = float(WRITTEN[0, 0])
    replace_same_size(copy / DATA, negated((copy / DATA).read_bytes(), number))
    assert shown_states(copy)[0, 0] == -number


def test_a_file_that_changes_between_hash_and_reading_is_refused(copy: Path) -> None:
    plain(copy)
    source = opened(copy)
    source.content_blake2b(0, [CAMERA])
    replace_same_size(copy / DATA, negated((copy / DATA).read_bytes(), float(WRITTEN[0, 0])))
    with pytest.raises(RecordingError, match=f"{DATA} of rec was changed while it was read"):
        LeRobotFrames(source).numbers(0, [STATE])


def test_a_file_that_was_touched_or_copied_over_itself_is_the_same_file(copy: Path) -> None:
    files = HashedFiles(copy)
    before = files.hash_of([copy / DATA])
    content = (copy / DATA).read_bytes()
    (copy / DATA).unlink()
    (copy / DATA).write_bytes(content)
    files.check(copy / DATA)
    assert files.hash_of([copy / DATA]) == before


@pytest.mark.slow
def test_a_run_does_not_grow_after_a_file_was_replaced_with_its_old_time_stamp(
    copy: Path, pi0_tiny: Pi0, tmp_path: Path
) -> None:
    plain(copy)

    def run(episodes: tuple[int, ...]) -> None:
        source = LeRobotSource(str(copy), episodes=episodes)
        prepare(ExtractSettings("pi0-tiny", source=source, env_workers=0), model=pi0_tiny).run(tmp_path / "run")

    run((0,))
    replace_same_size(copy / DATA, negated((copy / DATA).read_bytes(), float(WRITTEN[0, 1])))
    for episodes in ((0,), (0, 1)):
        with pytest.raises(SettingsMismatchError, match="the files that episode-000000 shows have changed"):
            run(episodes)


@pytest.mark.slow
def test_an_episode_whose_files_change_after_the_plan_is_given_up_by_name(
    copy: Path, pi0_tiny: Pi0, tmp_path: Path
) -> None:
    from probe_kit.errors import ProbeKitError

    plain(copy)
    source = LeRobotSource(str(copy), episodes=(0,))
    prepared = prepare(ExtractSettings("pi0-tiny", source=source, env_workers=0), model=pi0_tiny)
    replace_same_size(copy / DATA, negated((copy / DATA).read_bytes(), float(WRITTEN[0, 0])))
    with pytest.raises(ProbeKitError, match="the files of episode-000000 were changed after the run was planned"):
        prepared.run(tmp_path / "run")


@pytest.mark.parametrize("most", [0, 1_000_000])
@pytest.mark.parametrize("groups", [None, 1, 4])
def test_rows_are_the_episodes_own_however_a_file_is_divided(
    copy: Path, groups: int | None, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """most: bytes that are read at once of a whole file."""
    monkeypatch.setattr("probe_kit.extract.sources.lerobot_folder.MOST_AT_ONCE", most)
    pq.write_table(pq.read_table(copy / DATA), copy / DATA, row_group_size=groups)
    np.testing.assert_array_equal(shown_states(copy), WRITTEN)
    frames = LeRobotFrames(opened(copy))
    for episode, frame in ((2, 6), (0, 0), (1, 3), (1, 5)):
        picture = frames.pictures(episode, frame, [CAMERA])[CAMERA]
        np.testing.assert_array_equal(picture, observations()[episode][frame].image)


def test_a_picture_that_lies_outside_the_data_file_is_refused(copy: Path) -> None:
    """Only the data file is hashed."""
    elsewhere = copy / "picture.png"
    Image.new("RGB", (64, 48)).save(elsewhere)
    change(copy / DATA, CAMERA, lambda rows: [{"bytes": None, "path": str(elsewhere)} for _ in rows])
    with pytest.raises(RecordingError, match=r"frame 0 of episode 0 is not in the data file, which names .*png"):
        shown_states(copy)


def encoded(mode: str, kind: str) -> bytes:
    """A black picture, or one without any opaque pixel."""
    buffer = BytesIO()
    Image.new(mode, (64, 48)).save(buffer, kind)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "expected"),
    [(encoded("I;16", "PNG"), "has more than 8 bits per channel"), (encoded("RGB", "TIFF"), "is TIFF; expected")],
)
def test_deep_pictures_and_other_formats_are_refused(copy: Path, content: bytes, expected: str) -> None:
    change(copy / DATA, CAMERA, lambda rows: [{"bytes": content, "path": None} for _ in rows])
    with pytest.raises(RecordingError, match=f"at frame 0 of episode 0: {expected}"):
        shown_states(copy)


@pytest.mark.parametrize(("mode", "value"), [("RGBA", 255), ("L", 0)])
def test_transparency_is_white_and_grey_is_rgb_as_in_suites(copy: Path, mode: str, value: int) -> None:
    content = encoded(mode, "PNG")
    change(copy / DATA, CAMERA, lambda rows: [{"bytes": content, "path": None} for _ in rows])
    picture = LeRobotFrames(opened(copy)).pictures(0, 0, [CAMERA])[CAMERA]
    np.testing.assert_array_equal(picture, np.full((48, 64, 3), value, np.uint8))


def test_half_a_picture_is_refused_by_its_frame(copy: Path) -> None:
    change(copy / DATA, CAMERA, lambda rows: [{**row, "bytes": row["bytes"][:400]} for row in rows])
    with pytest.raises(RecordingError, match=r"the picture of .* at frame 0 of episode 0: not a picture"):
        shown_states(copy)


# -- meta and data contradict each other --------------------------------------------------------------------------


def remove_episode(folder: Path) -> None:
    for name in (DATA, EPISODES):
        table = pq.read_table(folder / name).to_pandas()
        pq.write_table(
            pa.Table.from_pandas(table[table["episode_index"] != 1], preserve_index=False), folder / name
        )
    edit_info(folder, total_episodes=2, total_frames=12)


CONTRADICTIONS: dict[str, tuple[Callable[[Path], None], str]] = {
    "an episode was removed by hand": (remove_episode, "and not episode 1; expected all from 0 on"),
    "total_episodes": (lambda f: edit_info(f, total_episodes=2), "has total_episodes 2; its tables have 3"),
    "more total_episodes": (lambda f: edit_info(f, total_episodes=4), "and not episode 3; expected all"),
    "total_frames": (lambda f: edit_info(f, total_frames=17), "has total_frames 17; its tables have 18"),
    "total_tasks": (lambda f: edit_info(f, total_tasks=3), "has total_tasks 3; its tables have 2"),
    "fps of zero": (lambda f: edit_info(f, fps=0), "has fps 0; expected a number above 0"),
    "fps as text": (lambda f: edit_info(f, fps="5"), "has fps '5'; expected a number above 0"),
    "another fps": (lambda f: edit_info(f, fps=10), r"frame 1 at 0\.2000 s; expected frame 1 at 0\.1000 s"),
    "lance": (
        lambda f: edit_info(f, storage_format="lance"),
        "has the storage_format 'lance'; this version reads",
    ),
    "no features": (lambda f: edit_info(f, features=[]), "has no features with dtype and shape each"),
    "length": (
        lambda f: change(f / EPISODES, "length", lambda rows: [4, *rows[1:]]),
        "says that episode 0 has 4 frames, and the indices 0 to 5",
    ),
    "an empty length": (
        lambda f: change(f / EPISODES, "length", lambda rows: [None, *rows[1:]]),
        "has length None for episode 0; expected a whole number",
    ),
    "beginnings": (
        lambda f: (
            change(f / EPISODES, "dataset_from_index", lambda rows: [rows[0], rows[1] + 1, rows[2]]),
            change(f / EPISODES, "dataset_to_index", lambda rows: [rows[0], rows[1] + 1, rows[2]]),
        )[0],
        "says that episode 1 begins at index 6; expected 5",
    ),
    "doubled index": (
        lambda f: change(f / DATA, "index", lambda rows: [*rows[:-1], rows[-2]]),
        r"row 17 has the index 16 and is of episode 2; expected the index 17 of episode 2",
    ),
    "a frame too many": (
        lambda f: pq.write_table(
            pa.concat_tables([pq.read_table(f / DATA), pq.read_table(f / DATA).slice(17)]), f / DATA
        ),
        "holds 8 frames of episode 2; meta/episodes says 7",
    ),
    "an episode without meta": (
        lambda f: change(f / DATA, "episode_index", lambda rows: [*rows[:-1], 9]),
        "holds frames of episode 9, which meta/episodes does not name",
    ),
    "frames in another order": (
        lambda f: pq.write_table(pq.read_table(f / DATA).take([1, 0, *range(2, 18)]), f / DATA),
        "row 0 has the index 1 and is of episode 0; expected the index 0",
    ),
    "states of another width": (
        lambda f: change(f / DATA, STATE, lambda rows: [row[:7] for row in rows], kind=pa.list_(pa.float32())),
        "observation.state has 7 numbers in the data and 8 in meta",
    ),
    "a column that is missing": (
        lambda f: pq.write_table(pq.read_table(f / DATA).drop_columns([STATE]), f / DATA),
        "has no column 'observation.state', which meta/info.json names",
    ),
    "names that occur twice": (
        lambda f: rename(f, [*"abcdefg", "a"]),
        "names two numbers of observation.state 'a'; expected each name once",
    ),
    "half a data file": (
        lambda f: (f / DATA).write_bytes((f / DATA).read_bytes()[:-100]) and None,
        "file-000.parquet cannot be read",
    ),
    "half of meta": (
        lambda f: (f / EPISODES).write_bytes((f / EPISODES).read_bytes()[:-100]) and None,
        "meta/episodes/chunk-000/file-000.parquet cannot be read",
    ),
    "a path without a name": (lambda f: edit_info(f, data_path="data/{other}"), "names no file of chunk_index"),
}


def rename(folder: Path, names: Any) -> None:
    features = json.loads((folder / "meta/info.json").read_text(encoding="utf-8"))["features"]
    features[STATE]["names"] = names
    edit_info(folder, features=features)


@pytest.mark.parametrize("kind", CONTRADICTIONS)
def test_meta_that_contradicts_itself_or_its_data_is_refused(copy: Path, kind: str) -> None:
    break_it, message = CONTRADICTIONS[kind]
    break_it(copy)
    with pytest.raises(RecordingError, match=message) as raised:
        shown_states(copy)
    assert "HUB" not in str(raised.value)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ([*"hgfedcba"], [*"hgfedcba"]),
        ({"motors": [*"abcdefgh"]}, [*"abcdefgh"]),
        ({"left": [*"abcd"], "right": [*"efgh"]}, [*"abcdefgh"]),
        ({name: 7 - position for position, name in enumerate("abcdefgh")}, [*"hgfedcba"]),
        (None, [*"01234567"]),
        ([*"abc"], [*"01234567"]),
        ("abcdefgh", [*"01234567"]),
        ({"a": "b"}, [*"01234567"]),
    ],
)
def test_names_of_numbers_are_a_list_groups_or_places(copy: Path, names: Any, expected: list[str]) -> None:
    rename(copy, names)
    assert opened(copy).names(STATE) == expected


# -- tasks --------------------------------------------------------------------------------------------------------

TEXTS = ["Put the cube on the gray shape", "Put the cube on the red shape"]


def tasks(folder: Path) -> list[str]:
    source = opened(folder)
    frames = LeRobotFrames(source)
    numbers = {
        int(number)
        for episode in range(3)
        for number in frames.numbers(episode, ["task_index"])["task_index"][:, 0]
    }
    return sorted(map(source.task, numbers))


def retask(folder: Path, of: Callable[[pd.DataFrame], pd.DataFrame], index: bool = False) -> None:
    path = folder / "meta/tasks.parquet"
    table = pd.read_parquet(path).reset_index(names="task")
    of(table).to_parquet(path, index=index)


@pytest.mark.parametrize(
    ("of", "index"),
    [
        (lambda table: table, False),
        (lambda table: table[["task", "task_index"]], False),
        (lambda table: table.set_index("task"), True),
        (lambda table: table.set_index("task").rename_axis(None), True),
        (lambda table: table.set_index("task").rename_axis("text"), True),
        (lambda table: table.iloc[::-1], True),
        (lambda table: table.set_index("task", drop=False).rename_axis("words"), True),
        (lambda table: table.assign(task=table["task"].astype("category")), False),
    ],
)
def test_texts_of_tasks_are_a_column_or_the_index_of_pandas(
    copy: Path, of: Callable[[pd.DataFrame], pd.DataFrame], index: bool
) -> None:
    retask(copy, of, index)
    assert tasks(copy) == TEXTS


@pytest.mark.parametrize(
    ("of", "message"),
    [
        (lambda table: table.assign(task=[1, 2]), "expected task_index, and the texts of the tasks in one column"),
        (lambda table: table.rename(columns={"task": "words"}), "has the columns words, task_index; expected"),
        (lambda table: table[["task"]], "has the columns task; expected task_index"),
        (
            lambda table: table.assign(task=["", None]),
            "as the task 0, which a frame names; expected a text",
        ),
        (lambda table: table.assign(task_index=0), "has 2 tasks of the number 0"),
    ],
)
def test_tasks_that_are_no_texts_are_refused(
    copy: Path, of: Callable[[pd.DataFrame], pd.DataFrame], message: str
) -> None:
    retask(copy, of)
    with pytest.raises(RecordingError, match=message):
        tasks(copy)


def test_an_empty_task_names_its_episodes(copy: Path) -> None:
    """Before a model is loaded, and only where a chosen episode has the task."""
    retask(copy, lambda table: table.assign(task=["" if number == 0 else "go" for number in table["task_index"]]))
    numbers = pd.read_parquet(copy / DATA)[["episode_index", "task_index"]]
    empty = sorted(set(numbers[numbers["task_index"] == 0]["episode_index"].tolist()))
    with pytest.raises(RecordingError, match=rf"'' as the task 0, which frames of episodes? {empty[0]}.* name"):
        _ = LeRobotSource(str(copy)).open().instructions
    assert LeRobotSource(str(copy), instruction="go").open().instructions == ("go",)


# -- videos -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def filmed(_lerobot_cache: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("filmed") / "rec"
    shades = [[view.__class__(np.full((48, 64, 3), 40 * row + 8 * frame, np.uint8), view.state, view.instruction)
               for frame, view in enumerate(episode)] for row, episode in enumerate(observations())]  # fmt: skip
    return write_recording(folder, shades, videos=True)


def time(folder: Path, part: str, of: Callable[[list[float]], list[float]]) -> None:
    change(folder / EPISODES, f"videos/{CAMERA}/{part}_timestamp", of)


@pytest.mark.parametrize("name", ["set[1]", "100%d", "a:b"])
def test_videos_show_the_frames_of_their_episode_whatever_the_folder_is_called(
    filmed: Path, tmp_path: Path, name: str
) -> None:
    frames = LeRobotFrames(opened(Path(shutil.copytree(filmed, tmp_path / name))))
    frames.check(range(3), [CAMERA])
    for episode, frame in ((0, 0), (1, 2), (2, 6), (1, 5)):
        picture = frames.pictures(episode, frame, [CAMERA])[CAMERA]
        assert abs(float(picture.mean()) - (40 * episode + 8 * frame)) < 4


VIDEOS: dict[str, tuple[Callable[[Path], None], str]] = {
    "a range begins a frame late": (
        lambda f: time(f, "from", lambda rows: [rows[0], rows[1] + 1 / FPS, rows[2]]),
        r"show episode 1, of 6 frames; expected 1\.2000 s",
    ),
    "a range is a frame too long": (
        lambda f: time(f, "to", lambda rows: [rows[0], rows[1] + 1 / FPS, rows[2]]),
        "show episode 1, of 6 frames",
    ),
    "ranges overlap": (
        lambda f: (
            time(f, "from", lambda rows: [rows[0], rows[1] - 1 / FPS, rows[2]]),
            time(f, "to", lambda rows: [rows[0], rows[1] - 1 / FPS, rows[2]]),
        )[0],
        r"shows episode 0 until 1\.0000 s and episode 1 from 0\.8000 s on; expected ranges that do not overlap",
    ),
    "a range ends behind the video": (
        lambda f: (
            time(f, "from", lambda rows: [*rows[:2], rows[2] + 1]),
            time(f, "to", lambda rows: [*rows[:2], rows[2] + 1]),
        )[0],
        r"ends at 3\.6000 s and has 5 frames per second; meta says .* episode 2 until 4\.6000 s",
    ),
    "a range that is not a number": (
        lambda f: time(f, "from", lambda rows: [float("nan"), *rows[1:]]),
        "expected seconds",
    ),
    "no video": (lambda f: next(f.rglob("*.mp4")).write_bytes(b"none") and None, "is no video that PyAV opens"),
    "no file": (lambda f: next(f.rglob("*.mp4")).unlink(), r"file-000\.mp4 of episode 0 is missing"),
    "another rate": (lambda f: edit_rate(f, 10), "has 10 frames per second, and the data set 5"),
}


def edit_rate(folder: Path, rate: float) -> None:
    features = json.loads((folder / "meta/info.json").read_text(encoding="utf-8"))["features"]
    features[CAMERA]["info"]["video.fps"] = rate
    edit_info(folder, features=features)


@pytest.mark.parametrize("kind", VIDEOS)
def test_time_ranges_of_videos_that_do_not_fit_are_refused(filmed: Path, tmp_path: Path, kind: str) -> None:
    folder = Path(shutil.copytree(filmed, tmp_path / "rec"))
    break_it, message = VIDEOS[kind]
    break_it(folder)
    with pytest.raises(RecordingError, match=message):
        shown_states(folder)


# -- what is shown, and against what ------------------------------------------------------------------------------


def shown_by_command(typed: dict[str, Any], folder: Path, model: str | None = None) -> None:
    """Print a data set as `probe-kit dataset show` does. typed: options by parameter."""
    command: Any = show_dataset
    command.__wrapped__(typed, str(folder), model)


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda f: next((f / "data").rglob("*.parquet")).unlink(), r"file-000\.parquet of episode 0 is missing"),
        (
            lambda f: change(f / DATA, "timestamp", lambda rows: [*rows[:-1], 9.0]),
            r"line 6 is frame 6 at 9\.0000 s",
        ),
        (
            lambda f: change(f / DATA, CAMERA, lambda rows: [{"bytes": b"", "path": None} for _ in rows]),
            "not a picture",
        ),
        (lambda f: shutil.copy(f / DATA, f / "data/chunk-000/file-001.parquet"), "meta/episodes names no episode"),
    ],
)
def test_a_data_set_is_not_described_where_extract_would_refuse_it(
    copy: Path, break_it: Callable[[Path], None], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    shown_by_command({}, copy)
    assert "3 of 3, 5 to 7 frames each" in capsys.readouterr().out
    break_it(copy)
    with pytest.raises(RecordingError, match=message):
        shown_by_command({"instruction": "Put the cube on the red shape"}, copy)


@pytest.mark.slow
def test_a_data_set_in_other_units_is_shown_and_then_refused_unless_accepted(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change(copy / DATA, STATE, lambda rows: [[1000 * number for number in row] for row in rows])
    with pytest.raises(UnitsError, match=r"rec, observation\.state: .*s0 \(number 0\).* 1,000 times larger"):
        shown_by_command({}, copy, "pi0-tiny")
    assert "outside the checkpoint's statistics: s0 100" in capsys.readouterr().out
    shown_by_command({"accept_units": True}, copy, "pi0-tiny")


@pytest.mark.parametrize(
    ("recorded", "action_names", "reason"),
    [
        ([*"yxzabcg"], tuple("xyzabcg"), "named in another order: y, x, z"),
        ([*"xyzabch"], tuple("xyzabcg"), "named otherwise: x, y, z"),
        ([*"xyzabcg"], tuple("xyzabcg"), "do not fit the statistics"),
        (None, tuple("xyzabcg"), "do not fit the statistics"),
        ([*"xyzabcg"], None, "do not fit the statistics"),
    ],
)
def test_actions_are_compared_with_recorded_ones_of_the_same_names_in_the_same_order_only(
    copy: Path, pi0_tiny: Pi0, monkeypatch: pytest.MonkeyPatch, recorded: Any, action_names: Any, reason: str
) -> None:
    """The recorded numbers themselves lie outside the statistics."""
    features = json.loads((copy / "meta/info.json").read_text(encoding="utf-8"))["features"]
    features["action"]["names"] = recorded
    edit_info(copy, features=features)
    monkeypatch.setattr(Pi0, "action_names", property(lambda _self: action_names))
    prepared = prepare(ExtractSettings("pi0-tiny", source=LeRobotSource(str(copy)), env_workers=0), model=pi0_tiny)
    assert reason in prepared.plan.selection["recording"]["other_actions"]


# -- what does not fit -------------------------------------------------------------------------------------------


def misfit(folder: Path, state: int, words: str, camera: str) -> ExtractSettings:
    """A recording with a state of so many numbers, such words and a camera of that name of the model."""
    episodes = [
        [replace(observation, state=observation.state[:state], instruction=words) for observation in episode]
        for episode in observations()
    ]
    write_recording(folder, episodes)
    source = LeRobotSource(str(folder), cameras=((camera, CAMERA),))
    return ExtractSettings("pi0-tiny", source=source, env_workers=0)


def test_camera_words_and_state_that_do_not_fit_are_refused_together_before_a_network_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("probe_kit.hooks.load_policy", lambda *_: pytest.fail("it was loaded"))
    settings = misfit(tmp_path / "rec", 6, "Stack the plates", "wrist")
    with pytest.raises(RecordingError) as refused:
        prepare(settings)
    message = str(refused.value)
    assert message.startswith("3 things about the recordings do not fit the model")
    assert "--camera wrist" in message
    assert "'plates'" in message
    assert "has 6 numbers as observation.state; pi0-tiny reads 8" in message


@pytest.mark.parametrize(
    ("state", "words", "camera", "error", "message"),
    [
        (8, "Put the cube on the red shape", "wrist", RecordingError, "--camera wrist"),
        (8, "Stack the plates", "base", InstructionError, "plates"),
        (6, "Put the cube on the red shape", "base", RecordingError, "6 numbers"),
    ],
)
def test_one_thing_that_does_not_fit_is_its_own_error(
    state: int, words: str, camera: str, error: type[Exception], message: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message) as refused:
        prepare(misfit(tmp_path / "rec", state, words, camera))
    assert "things" not in str(refused.value)


def test_camera_and_state_are_refused_together_where_only_the_loaded_model_knows_them(
    pi0_tiny: Pi0, tmp_path: Path
) -> None:
    settings = misfit(tmp_path / "rec", 6, "Put the cube on the red shape", "wrist")
    with pytest.raises(RecordingError, match=r"2 things(.|\n)*wrist(.|\n)*6 numbers"):
        prepare(settings, model=pi0_tiny)
