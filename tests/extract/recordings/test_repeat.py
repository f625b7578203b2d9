"""A run is made again from its `run.json`, wherever its command was typed: one promise for every source."""

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import probe_kit as pk
from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.extract import ExtractSettings
from probe_kit.extract.config_files import read_config
from probe_kit.runs.reader import Origin
from probe_kit.suite import Suite

RED = "Put the cube on the red shape"
SOURCES = ("scene", "scene with a photo", "recordings", "environment", "pictures")
FILES = {
    "scene": "suite", "scene with a photo": "photo.png", "recordings": "rec", "environment": "reach_env.py",
    "pictures": "pictures",
}  # fmt: skip


@pytest.fixture(
    params=[
        pytest.param(source, marks=pytest.mark.slow if source not in ("scene", "recordings") else ())
        for source in SOURCES
    ]
)
def made(
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


def test_a_run_is_repeated_from_any_folder_and_its_files_are_found_again(
    made: tuple[str, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, home, first = made
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


def test_a_file_that_is_gone_is_named_before_anything_is_made(
    made: tuple[str, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, home, first = made
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


def test_an_option_takes_the_place_of_every_file_that_was_moved(
    made: tuple[str, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, home, first = made
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
    here = after.origins[0].files
    assert all(str(tmp_path / "elsewhere") in path for path in here.values())
    assert here.keys() == before.origins[0].files.keys()


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
def test_a_source_of_another_kind_needs_no_file_of_the_run(made: tuple[str, Path, Path], tmp_path: Path) -> None:
    source, home, first = made
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
