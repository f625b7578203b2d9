"""Runs below a folder: found at any depth, listed and opened together, and refused where there is none."""

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit._terminal import console
from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.runs.run_folders import find_runs, runs_in
from probe_kit.view.commands import _opened


@pytest.fixture
def folder(labelled_run: Path, tmp_path: Path) -> Path:
    for name in ("b", "deep/a"):
        shutil.copytree(labelled_run, tmp_path / "runs" / name)
    return tmp_path / "runs"


def test_runs_are_found_at_any_depth_in_the_order_of_their_paths(folder: Path) -> None:
    assert find_runs(folder) == [folder / "b", folder / "deep" / "a"]
    assert find_runs(folder / "b") == [folder / "b"], "a run is the only one of its own folder"
    assert runs_in(folder, deep=False) == [folder / "b"]


def test_a_folder_without_a_run_is_refused(folder: Path) -> None:
    (folder / "empty").mkdir()
    with pytest.raises(UsageError, match="there is no run below"):
        find_runs(folder / "empty")
    with pytest.raises(UsageError, match="is no folder of this machine"):
        find_runs(folder / "none")


def test_the_list_names_every_run_and_the_one_that_cannot_be_read(folder: Path) -> None:
    (folder / "broken").mkdir()
    (folder / "broken" / "run.json").write_text("{", encoding="utf-8")
    done = CliRunner().invoke(app, ["run", "list", str(folder), "--format", "json"])
    assert done.exit_code == 0, done.output
    lines = json.loads(done.stdout)
    assert [line["run"] for line in lines] == ["b", "broken", "deep/a"]
    assert "error" in lines[1]
    assert lines[0]["episodes"] == lines[2]["episodes"] > 0
    printed = CliRunner().invoke(app, ["run", "list", str(folder)])
    assert "deep/a" in printed.stdout
    assert "broken cannot be read" in printed.stderr


def test_names_of_runs_can_be_copied_from_a_narrow_terminal(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "light/base/plain-0123456789"
    (folder / name).parent.mkdir(parents=True)
    (folder / "b").rename(folder / name)
    monkeypatch.setattr(console.out, "_width", 60)
    assert name in CliRunner().invoke(app, ["run", "list", str(folder)]).stdout


def test_the_viewer_opens_all_runs_of_a_folder(folder: Path) -> None:
    assert [run.location.name for run in _opened([str(folder)], True)] == ["b", "a"]
