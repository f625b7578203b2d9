"""What can be chosen of recordings, and what is refused before anything is read."""

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner, Result

import probe_kit as pk
from probe_kit.cli import app
from probe_kit.errors import MissingExtraError, RecordingError, UsageError
from probe_kit.extract import ExtractSettings, LeRobotSource, prepare
from probe_kit.extract.config_files import read_config
from probe_kit.extract.extraction import check_meaningless
from probe_kit.extract.sources.lerobot_folder import open_lerobot, resolved_commit
from probe_kit.extract.sources.recording import degrees_of, read_episodes
from probe_kit.extract.sources.recording_source import mapped_cameras
from probe_kit.hooks import load_model
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs import verify_run
from probe_kit.runs.plan import Row
from probe_kit.runs.run_source import Origin
from probe_kit.suite import Suite
from tests.support.slow_cases import slow_but

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
    ("maps", "message"),
    [
        ({"cameras": ["base"]}, "expected CAMERA=VALUE"),
        ({"cameras": ["base=a", "base=b"]}, "camera 'base' is mapped twice"),
        ({"cameras": ["base=a", "wrist=a"]}, "feature 'a' is mapped twice"),
        ({"rotations": ["base=45"]}, "rotated by 45 degrees; expected one of 90, 180, 270"),
        ({"rotations": ["base=up"]}, "expected degrees"),
        ({"rotations": ["up"]}, "--rotate up; expected degrees, such as 180"),
        ({"rotations": ["base=90", "base=180"]}, "--rotate gives base twice"),
    ],
)
def test_maps_that_cannot_be_meant_are_refused(maps: dict[str, list[str]], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        LeRobotSource("folder", **maps)  # type: ignore[arg-type]


@pytest.mark.parametrize("rotation_options", [["180"], ["180", "wrist=90"], {"*": 180}, [("*", 180)], 180])
def test_degrees_without_a_camera_rotate_all_and_those_of_a_camera_count_before(rotation_options: Any) -> None:
    rotations = LeRobotSource("folder", rotations=rotation_options).rotations
    assert degrees_of(rotations, "base") == 180
    assert degrees_of(rotations, "wrist") == (90 if len(rotations) > 1 else 180)
    assert degrees_of((("base", 90),), "wrist") == 0


# -- cameras --------------------------------------------------------------------------------------------------


def test_equal_names_need_no_map() -> None:
    assert mapped_cameras((), ["top", "wrist"], [WRIST, TOP]) == (("top", TOP), ("wrist", WRIST))


def test_the_only_picture_goes_to_the_only_camera() -> None:
    assert mapped_cameras((), ["base"], [TOP]) == (("base", TOP),)


def test_a_map_is_ordered_as_the_model_has_its_cameras() -> None:
    camera_map = (("wrist", TOP), ("base", WRIST))
    assert mapped_cameras(camera_map, ["base", "wrist"], [TOP, WRIST]) == (("base", WRIST), ("wrist", TOP))


@pytest.mark.parametrize(
    ("camera_map", "model", "recorded"),
    [
        ((), ["base"], [TOP, WRIST]),
        ((), ["base", "wrist"], [WRIST]),
        ((("wrist", WRIST),), ["base", "wrist"], [TOP, WRIST]),
        ((), ["base"], []),
    ],
)
def test_cameras_that_nothing_decides_are_refused_with_both_lists(
    camera_map: tuple[tuple[str, str], ...], model: list[str], recorded: list[str]
) -> None:
    with pytest.raises(RecordingError, match=r"the model has base.*the data set has.*--camera base="):
        mapped_cameras(camera_map, model, recorded)


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
        with pytest.raises(
            UsageError, match="the commit of this data set cannot be looked up on the hub: offline mode"
        ):
            resolved_commit("someone/kitchen", revision)
    assert resolved_commit("someone/kitchen", COMMIT) == COMMIT


def test_a_data_set_of_the_hub_is_told_from_a_folder(tmp_path: Path) -> None:
    assert LeRobotSource(str(tmp_path)).is_local
    assert LeRobotSource("some/where/deep").is_local, "a folder that is missing"
    assert not LeRobotSource(f"someone/kitchen@{COMMIT}").is_local
    assert LeRobotSource(f"someone/kitchen@{COMMIT}").name == "someone/kitchen"


def test_options_of_scenes_are_refused_with_recordings(tmp_path: Path) -> None:
    source = LeRobotSource(str(tmp_path))
    for options in ({"items": 4}, {"categories": ("color",)}, {"execute": 2}, {"video": "all"}, {"batch": "auto"}):
        with pytest.raises(UsageError, match="does not apply with --dataset"):
            check_meaningless(ExtractSettings("pi0-tiny", source=source, **options))  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="expert is scripted and looks at nothing"):
        prepare(ExtractSettings("expert", source=source))
    for typed, flag in (({"max_steps": 3}, "--max-steps"), ({"captured_calls": 2}, "--captured-calls")):
        with pytest.raises(UsageError, match=f"{flag} does not apply with --dataset"):
            ExtractSettings.of_command({"model": "pi0-tiny", "dataset": "x", **typed})


def test_options_of_recordings_are_refused_without_them() -> None:
    with pytest.raises(UsageError, match="--episodes, --no-pixels is for recordings; give --dataset"):
        ExtractSettings.of_command({"model": "pi0-tiny", "episodes": "0:5", "no_pixels": False})


TEXTS = ("Put the cube on the red shape", "Put the cube on the gray shape")
FIRST = pk.Site("backbone", 2)


@pytest.fixture
def home(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with recordings, a module of an environment, and twelve pictures with labels."""
    shutil.copytree(recording, tmp_path / "rec")
    shutil.copy(Path(__file__).parents[2] / "support" / "reach_env.py", tmp_path / "reach_asked.py")
    (tmp_path / "pictures").mkdir()
    lines = ["picture,instruction,red"]
    for number in range(12):
        picture = np.random.default_rng(number).integers(0, 256, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(picture).save(tmp_path / "pictures" / f"{number}.png")
        lines.append(f"{number}.png,{TEXTS[number % 2]},{number // 2 % 2}")
    (tmp_path / "table.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return tmp_path


def ask(*words: str) -> Result:
    return CliRunner().invoke(app, ["ask", "--model", "vlm-tiny", "--env-workers", "0", *words])


ASKED = {
    "recordings": (("--dataset", "rec", "--select", "every:2"), 10),
    "environment": (("--env", "reach_asked:ReachEnv", "--episodes", "0:3"), 3),
    "pictures": (("--pictures", "pictures", "--table", "table.csv"), 12),
}


@pytest.mark.parametrize("source", slow_but(["recordings"], ASKED))
def test_a_model_is_asked_about_every_frame_episode_or_picture(source: str, home: Path) -> None:
    options, count = ASKED[source]
    result = ask(*options, "--tokens", "pooled", "--out", "asked")
    assert result.exit_code == 0, result.output
    assert "next: probe-kit targets" in " ".join(result.stderr.split())
    run = pk.open_run(home / "asked" / "instruction")
    assert verify_run(run.path, deep=True).ok
    assert len(run.episodes) == count
    assert set(run.episodes["question"]) <= {*run.episodes["instruction"]}
    assert set(run.episodes["outcome"]) <= {"answered", "oob"}
    assert not {"side_correct", "option_mass"} & set(run.episodes)
    assert run.column(FIRST, "mean").shape[0] == count
    if source == "recordings":
        assert run.episodes["frames"].tolist() == [1] * count
        assert run.control_steps[:, 0].tolist() == [0, 2, 4, 0, 2, 4, 0, 2, 4, 6]
    with pytest.raises(UsageError, match="no column side_correct"):
        pk.retention_table([run])


@pytest.mark.slow
def test_a_run_of_questions_is_repeated_from_its_own_settings(home: Path) -> None:
    options, _ = ASKED["pictures"]
    assert ask(*options, "--tokens", "pooled", "--out", "asked").exit_code == 0
    first = home / "asked" / "instruction"
    again = CliRunner().invoke(app, ["ask", "--config", str(first), "--env-workers", "0", "--out", "again"])
    assert again.exit_code == 0, again.output
    assert (first / "run.json").read_bytes() == (home / "again" / "instruction" / "run.json").read_bytes()
    refused = CliRunner().invoke(app, ["extract", "--config", str(first)])
    assert refused.exit_code == 2
    assert "repeat it with `probe-kit ask --config" in " ".join(refused.stderr.split())


@pytest.mark.slow
def test_activations_are_those_of_the_model_itself_and_numbers_of_the_table_are_probed(home: Path) -> None:
    options, _ = ASKED["pictures"]
    assert ask(*options, "--tokens", "pooled", "--out", "asked").exit_code == 0
    run = pk.open_run(home / "asked" / "instruction")
    model = load_model("vlm-tiny")
    model.match_policies(True)  # type: ignore[attr-defined]
    picture = np.array(Image.open(home / "pictures" / "5.png"))
    observation = Observation(picture, np.zeros(8, np.float32), TEXTS[1])
    from probe_kit.hooks import Prompt, capture

    question = Prompt(observation, TEXTS[1], (f"{model.lead}Yes", f"{model.lead}No"))  # type: ignore[attr-defined]
    with capture(model, [FIRST]) as cache:
        model.read([question])  # type: ignore[attr-defined]
    np.testing.assert_allclose(run.column(FIRST, "last")[5], cache[FIRST][0, -1].numpy(), atol=1e-5)
    results = pk.train_probes(run, target="dataset.red", permutations=9, controls=("instruction",))
    assert np.isfinite(results.scores["score"]).all()


@pytest.mark.slow
def test_yes_and_no_are_read_where_the_prompt_asks_for_them(home: Path) -> None:
    (home / "seen.txt").write_text("{instruction}. Do you see the cube? Answer yes or no.", encoding="utf-8")
    options, count = ASKED["pictures"]
    result = ask(*options, "--prompt", "seen.txt", "--out", "asked")
    assert result.exit_code == 0, result.output
    episodes = pk.open_run(home / "asked" / "seen").episodes
    assert {"logit_yes", "logit_no", "option_mass", "said"} <= set(episodes)
    assert len(episodes) == count


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--prompt", "p1"), "p1 asks for an object of a suite, and pictures have none. Use --prompt instruction"),
        (("--picture", "side-by-side"), "--picture side-by-side does not apply with --pictures"),
        (("--query", "distractor"), "--query does not apply with --pictures"),
        (("--picture-size", "64x64"), "--picture-size does not apply with --pictures"),
        (("--items", "2"), "--items does not apply with --pictures"),
    ],
)
def test_recordings_refuse_by_name_the_options_of_a_suite(
    words: tuple[str, ...], message: str, home: Path
) -> None:
    del home
    options, _ = ASKED["pictures"]
    refused = ask(*options, *words, "--dry-run")
    assert refused.exit_code == 2, refused.output
    assert message in " ".join(refused.stderr.split())


RED = "Put the cube on the red shape"
SOURCES = ("scene", "scene with a photo", "recordings", "environment", "pictures")
FILES = {
    "scene": "suite", "scene with a photo": "photo.png", "recordings": "rec", "environment": "reach_env.py",
    "pictures": "pictures",
}  # fmt: skip


@pytest.fixture(
    params=[pytest.param(source, marks=pytest.mark.slow if source != "recordings" else ()) for source in SOURCES]
)
def run_and_files(
    request: pytest.FixtureRequest,
    recording: Path,
    small_suite: Suite,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[str, Path, Path]:
    """The source, the folder in which its command was typed with relative paths, and the run."""
    home = tmp_path / "home"
    home.mkdir()
    shutil.copytree(small_suite.folder, home / "suite")
    Image.new("RGB", (64, 48), "white").save(home / "photo.png")
    scene = ["--suite", "suite", "--items", "2", "--categories", "color", "--no-act"]
    photo = ["--rendering", "visual-matching", "--background", "photo.png"]
    shutil.copytree(recording, home / "rec")
    shutil.copy(Path(__file__).parents[2] / "support" / "reach_env.py", home)
    (home / "pictures").mkdir()
    for number in range(2):
        Image.new("RGB", (64, 48), (200 * number, 20, 20)).save(home / "pictures" / f"{number}.png")
    lines = "".join(f"{number}.png,{RED}\n" for number in range(2))
    (home / "table.csv").write_text(f"picture,instruction\n{lines}", encoding="utf-8")
    options = {
        "scene": scene,
        "scene with a photo": [*scene, *photo],
        "recordings": ["--dataset", "rec", "--episodes", "0", "--select", "every:2", "--accept-units"],
        "environment": ["--env", "reach_env:ReachEnv", "--episodes", "0:2", "--max-steps", "2"],
        "pictures": ["--pictures", "pictures", "--table", "table.csv"],
    }[request.param]
    monkeypatch.chdir(home)
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if not folder.endswith("support")])
    sys.modules.pop("reach_env", None)
    extract("--model", "pi0-tiny", *options, "--out", str(tmp_path / "run"))
    return request.param, home, tmp_path / "run"


def extract(*words: str, code: int = 0) -> str:
    ended = CliRunner().invoke(app, ["extract", *words, "--env-workers", "0"])
    assert ended.exit_code == code, ended.output
    return ended.output


@pytest.mark.slow
def test_a_run_is_repeated_from_any_folder_and_its_files_are_found_again(
    run_and_files: tuple[str, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, home, first = run_and_files
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if folder != str(home)])
    sys.modules.pop("reach_env", None)
    accepted = ["--accept-units"] if source == "recordings" else []
    extract("--config", str(first / "run.json"), "--out", "again", *accepted)
    before, after = pk.open_run(first), pk.open_run("again")
    assert before.root.identity == after.root.identity
    site = pk.Site("backbone", 3)
    np.testing.assert_array_equal(before.column(site, "mean"), after.column(site, "mean"))


@pytest.mark.slow
def test_a_file_that_is_gone_is_named_before_anything_is_made(
    run_and_files: tuple[str, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, home, first = run_and_files
    gone = home / FILES[source]
    gone.rename(home / "moved")
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if folder != str(home)])
    sys.modules.pop("reach_env", None)
    message = extract("--config", str(first), "--out", str(tmp_path / "again"), code=2)
    assert ("reach_env" if source == "environment" else str(gone)) in message.replace("\n", "")
    assert not (tmp_path / "again").exists()


AGAIN = {
    "scene": ["--suite", "moved/suite"],
    "scene with a photo": ["--suite", "moved/suite", "--background", "moved/photo.png"],
    "recordings": ["--dataset", "moved/rec"], "environment": ["--env", "reach_env:ReachEnv"],
    "pictures": ["--pictures", "moved/pictures", "--table", "moved/table.csv"],
}  # fmt: skip
"""The options that give what was moved; a module is imported from where the command is typed."""


@pytest.mark.slow
def test_an_option_takes_the_place_of_every_file_that_was_moved(
    run_and_files: tuple[str, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, home, first = run_and_files
    (tmp_path / "elsewhere").mkdir()
    home.rename(tmp_path / "elsewhere" / "moved")
    monkeypatch.chdir(tmp_path / "elsewhere" / ("moved" if source == "environment" else ""))
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if folder != str(home)])
    sys.modules.pop("reach_env", None)
    again = ["--config", str(first), "--out", str(tmp_path / "again")]
    option = AGAIN[source][0]
    assert f"Give it with {option}" in " ".join(extract(*again, code=2).split())
    accepted = ["--accept-units"] if source == "recordings" else []
    extract(*again, *AGAIN[source], *accepted)
    before, after = pk.open_run(first), pk.open_run(tmp_path / "again")
    assert before.root.identity == after.root.identity
    paths = after.origins[0].files
    assert all(str(tmp_path / "elsewhere") in path for path in paths.values())
    assert paths.keys() == before.origins[0].files.keys()


def test_files_of_the_model_that_were_moved_are_named_and_given_by_their_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lost checkpoint is never replaced by the family's default one."""
    from probe_kit.hooks.registry import find_family

    run = SimpleNamespace(
        location=tmp_path / "run",
        settings={"config": ExtractSettings("openvla", options={"tokenizer": "tok", "top_k": "3"}).config()},
        origins=[
            Origin(
                checkpoint=str(tmp_path / "weights"), options={"tokenizer": str(tmp_path / "tok"), "top_k": "3"}
            )
        ],
    )
    assert {"tokenizer", "top_k"} <= {option.name for option in find_family("openvla").options}
    monkeypatch.setattr("probe_kit.runs.run.open_run", lambda *_, **__: run)
    with pytest.raises(UsageError, match=r"weights, its checkpoint.*Give it with --checkpoint"):
        read_config(tmp_path, {})
    typed = {"checkpoint": "elsewhere"}
    with pytest.raises(UsageError, match=r"tok, its tokenizer.*Give it with -M tokenizer"):
        read_config(tmp_path, typed)
    typed |= {"model_option": ["tokenizer=other"]}
    model = ExtractSettings.of_command(typed, read_config(tmp_path, typed)).model
    assert (model.checkpoint, model.options) == ("elsewhere", {"tokenizer": "other", "top_k": "3"})


@pytest.mark.slow
def test_a_source_of_another_kind_needs_no_file_of_the_run(
    run_and_files: tuple[str, Path, Path], tmp_path: Path
) -> None:
    source, home, first = run_and_files
    home.rename(tmp_path / "gone")
    other = ["--env", "lerobot:pusht"] if source != "environment" else ["--dataset", "rec"]
    printed = json.loads(extract("--config", str(first), *other, "--print-config"))
    assert printed["source"]["kind"] == ("lerobot" if source == "environment" else "env")


@pytest.mark.slow
def test_a_photo_that_is_gone_is_named_with_its_option_which_gives_another(tmp_path: Path) -> None:
    for name in ("first.png", "second.png"):
        Image.new("RGB", (640, 480), (90, 90, 90)).save(tmp_path / name)
    photo = ["--rendering", "visual-matching", "--background", str(tmp_path / "first.png")]
    shape = ["--model", "idle", "--categories", "color", "--items", "2", "--max-steps", "2"]
    extract(*shape, *photo, "--out", str(tmp_path / "run"))
    (tmp_path / "first.png").unlink()
    again = ["--config", str(tmp_path / "run"), "--print-config"]
    assert "Give it with --background" in " ".join(extract(*again, code=2).split())
    assert "second.png" in extract(*again, "--background", str(tmp_path / "second.png"))
