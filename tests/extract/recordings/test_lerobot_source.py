"""What can be chosen of recordings, and what is refused before anything is read."""

import json
import sys
from pathlib import Path

import pytest

from probe_kit.errors import MissingExtraError, RecordingError, UsageError
from probe_kit.extract import ExtractSettings, LeRobotSource, prepare
from probe_kit.extract.extraction import check_meaningless
from probe_kit.extract.sources.lerobot_folder import open_lerobot, resolved_commit
from probe_kit.extract.sources.player import Row
from probe_kit.extract.sources.recording import read_episodes
from probe_kit.extract.sources.recording_source import mapped_cameras

COMMIT = "0123456789abcdef0123456789abcdef01234567"
TOP, WRIST = "observation.images.top", "observation.images.wrist"


@pytest.mark.parametrize(
    ("text", "episodes"), [("0:3", (0, 1, 2)), ("7", (7,)), ("5:7,1", (1, 5, 6)), ("0:1", (0,))]
)
def test_episodes_are_ranges_or_single_indices(text: str, episodes: tuple[int, ...]) -> None:
    assert read_episodes(text) == episodes


@pytest.mark.parametrize("text", ["", "3:3", "5:2", "-1", "a:b", "1-3", "0:9999999999", "٣:٤x"])
def test_other_words_for_episodes_are_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match=r"0:5"):
        read_episodes(text)


def test_episodes_are_shown_in_the_order_of_the_data_set_each_once() -> None:
    """lerobot gives episodes 7 and 3 as 3 and 7; the plan says so from the start."""
    assert LeRobotSource("x", episodes=[7, 3, 7]).episodes == (3, 7)


@pytest.mark.parametrize(("text", "every"), [("every:1", 1), ("every:25", 25)])
def test_frames_are_chosen_by_their_distance(text: str, every: int) -> None:
    assert LeRobotSource("folder", every=text).every == every


@pytest.mark.parametrize("text", ["every:0", "every", "5", "all", "every:-3"])
def test_other_words_for_frames_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="expected every:N"):
        LeRobotSource("folder", every=text)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"cameras": ["base"]}, "expected CAMERA=VALUE"),
        ({"cameras": ["base=a", "base=b"]}, "camera 'base' is mapped twice"),
        ({"cameras": ["base=a", "wrist=a"]}, "feature 'a' is mapped twice"),
        ({"rotations": ["base=45"]}, "rotated by 45 degrees; expected one of 90, 180, 270"),
        ({"rotations": ["base=up"]}, "expected degrees"),
    ],
)
def test_maps_that_cannot_be_meant_are_refused(given: dict[str, list[str]], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        LeRobotSource("folder", **given)  # type: ignore[arg-type]


# -- cameras --------------------------------------------------------------------------------------------------


def test_equal_names_need_no_map() -> None:
    assert mapped_cameras((), ["top", "wrist"], [WRIST, TOP]) == (("top", TOP), ("wrist", WRIST))


def test_the_only_picture_goes_to_the_only_camera() -> None:
    assert mapped_cameras((), ["base"], [TOP]) == (("base", TOP),)


def test_a_map_is_ordered_as_the_model_has_its_cameras() -> None:
    given = (("wrist", TOP), ("base", WRIST))
    assert mapped_cameras(given, ["base", "wrist"], [TOP, WRIST]) == (("base", WRIST), ("wrist", TOP))


@pytest.mark.parametrize(
    ("given", "model", "recorded"),
    [
        ((), ["base"], [TOP, WRIST]),
        ((), ["base", "wrist"], [WRIST]),
        ((("wrist", WRIST),), ["base", "wrist"], [TOP, WRIST]),
        ((), ["base"], []),
    ],
)
def test_cameras_that_nothing_decides_are_refused_with_both_lists(
    given: tuple[tuple[str, str], ...], model: list[str], recorded: list[str]
) -> None:
    with pytest.raises(RecordingError, match=r"the model has base.*the data set has.*--camera base="):
        mapped_cameras(given, model, recorded)


@pytest.mark.parametrize("pair", [("gripper", TOP), ("base", "observation.images.side")])
def test_a_map_of_what_is_not_there_is_refused(pair: tuple[str, str]) -> None:
    with pytest.raises(RecordingError, match="has no such"):
        mapped_cameras((pair,), ["base"], [TOP])


# -- rows -----------------------------------------------------------------------------------------------------


def test_a_frame_has_the_same_seed_whichever_other_frames_were_chosen() -> None:
    every, third = Row(0, {}, frames=range(20)), Row(9, {}, frames=range(0, 20, 3))
    assert [every.noise_of(call) for call in (0, 3, 6)] == [third.noise_of(call) for call in (0, 1, 2)]
    assert [third.control_step(call, 99) for call in range(3)] == [0, 3, 6]


# -- what is refused before lerobot is asked --------------------------------------------------------------------


def test_a_folder_that_is_no_data_set_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no LeRobotDataset: it has no meta/info\.json"):
        open_lerobot(LeRobotSource(str(tmp_path)))


def test_an_older_format_is_refused_with_the_converter(tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v2.1"}), encoding="utf-8")
    with pytest.raises(
        RecordingError, match=r"format v2\.1; this version reads v3\.0.*convert_dataset_v21_to_v30"
    ):
        open_lerobot(LeRobotSource(str(tmp_path)))


@pytest.mark.parametrize("missing", ["pyarrow", "av"])
def test_trap_8_without_the_extra_it_is_named_with_its_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    (tmp_path / "meta" / "episodes").mkdir(parents=True)
    (tmp_path / "meta" / "tasks.parquet").touch()
    (tmp_path / "meta" / "info.json").write_text('{"codebase_version": "v3.0"}', encoding="utf-8")
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(MissingExtraError, match=r"\[datasets\]|--extra datasets"):
        open_lerobot(LeRobotSource(str(tmp_path)))


def test_a_hub_name_without_a_commit_is_refused_without_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    for revision in ("", "main", COMMIT[:-1]):
        with pytest.raises(UsageError, match="names no commit, and the hub cannot be asked for one: offline mode"):
            resolved_commit("someone/kitchen", revision)
    assert resolved_commit("someone/kitchen", COMMIT) == COMMIT


def test_a_data_set_of_the_hub_is_told_from_a_folder(tmp_path: Path) -> None:
    assert LeRobotSource(str(tmp_path)).is_local
    assert LeRobotSource("some/where/deep").is_local, "a folder that is missing"
    assert not LeRobotSource(f"someone/kitchen@{COMMIT}").is_local
    assert LeRobotSource(f"someone/kitchen@{COMMIT}").name == "someone/kitchen"


def test_options_of_scenes_are_refused_with_recordings(tmp_path: Path) -> None:
    source = LeRobotSource(str(tmp_path))
    for given in ({"items": 4}, {"categories": ("color",)}, {"execute": 2}, {"video": "all"}, {"batch": "auto"}):
        with pytest.raises(UsageError, match="does not apply with --dataset"):
            check_meaningless(ExtractSettings("pi0-tiny", source=source, **given))  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="expert is scripted and looks at nothing"):
        prepare(ExtractSettings("expert", source=source))
    for typed, flag in (({"max_steps": 3}, "--max-steps"), ({"captured_calls": 2}, "--captured-calls")):
        with pytest.raises(UsageError, match=f"{flag} does not apply with --dataset"):
            ExtractSettings.of_command({"model": "pi0-tiny", "dataset": "x", **typed})


def test_options_of_recordings_are_refused_without_them() -> None:
    with pytest.raises(UsageError, match="--episodes, --no-pixels is for recordings; give --dataset"):
        ExtractSettings.of_command({"model": "pi0-tiny", "episodes": "0:5", "no_pixels": False})
