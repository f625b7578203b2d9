"""A run is made again from its `run.json`, wherever its command was typed: one promise for every source."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import probe_kit as pk
from probe_kit.cli import app
from probe_kit.suite import Suite

RED = "Put the cube on the red shape"
SOURCES = ("scene", "scene with a photo", "recordings", "environment", "pictures")
FILES = {
    "scene": "suite", "scene with a photo": "photo.png", "recordings": "rec", "environment": "reach_env.py",
    "pictures": "pictures",
}  # fmt: skip


@pytest.fixture(params=SOURCES)
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
