"""The export is a folder that needs nothing else, names nothing of this machine, and is always the same."""

import hashlib
import re
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UnknownCategoryError, UsageError
from probe_kit.runs import open_run
from probe_kit.view import write_viewer
from probe_kit.view.export import APP, page_files

MOST_BYTES = 130_000
"""Of the page's own files, without licences."""


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_same_runs_give_the_same_bytes(little_runs: Path, exported: Path, tmp_path: Path) -> None:
    again = write_viewer([open_run(little_runs / name) for name in ("run", "other")], tmp_path / "again")
    first = contents(exported.parent)
    assert first == contents(again.parent)
    assert {"index.html", "README", "data/index.js", "data/run/e/00000.js", "data/other/run.js"} <= first.keys()
    assert [name for name in first if name.endswith(".webp")] == [
        name for name in first if re.search(r"/f/0000[01]\.webp$", name)
    ]


def test_an_export_names_neither_folders_nor_users_of_this_machine(little_runs: Path, tmp_path: Path) -> None:
    place = tmp_path / "home" / "jane-doe" / "secret project"
    shutil.copytree(little_runs / "run", place / "run")
    page = write_viewer([open_run(place / "run")], tmp_path / "out")
    for name, content in contents(page.parent).items():
        for word in (str(tmp_path), "jane-doe", "secret project"):
            assert word.encode() not in content, name


def test_an_export_replaces_a_former_one_and_no_other_folder(little_runs: Path, tmp_path: Path) -> None:
    run = open_run(little_runs / "run")
    folder = tmp_path / "out"
    write_viewer([run], folder)
    (folder / "data" / "left.js").write_text("put(1)", encoding="utf-8")
    write_viewer([run], folder, frames=False)
    assert not (folder / "data" / "left.js").exists()
    assert not list(folder.rglob("*.webp"))
    (folder / "thesis.tex").write_text("mine", encoding="utf-8")
    with pytest.raises(UsageError, match=r"holds .* and is no former export"):
        write_viewer([run], folder)
    assert (folder / "thesis.tex").read_text(encoding="utf-8") == "mine"
    with pytest.raises(UsageError, match="is a file; give a folder"):
        write_viewer([run], folder / "thesis.tex")


def test_an_export_of_some_categories_holds_no_other(little_runs: Path, tmp_path: Path) -> None:
    run = open_run(little_runs / "run")
    with pytest.raises(UnknownCategoryError, match="no run has the category 'shape'; they have color"):
        write_viewer([run], tmp_path / "out", categories=["shape"])
    page = write_viewer([run], tmp_path / "out", categories=["color"])
    assert len(list((page.parent / "data" / "run" / "e").iterdir())) == len(run.episodes)


def test_the_command_prints_the_page(little_runs: Path, tmp_path: Path) -> None:
    arguments = ["view", str(little_runs / "run"), "--export", str(tmp_path / "out"), "--without-frames"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert done.stdout.strip() == str(tmp_path / "out" / "index.html")


def test_the_vendored_file_is_the_one_that_its_record_names() -> None:
    rows = re.findall(
        r"^\| `(\S+)` .* `([0-9a-f]{64})` \|$", (APP / "VENDORED.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert [name for name, _ in rows] == ["preact-htm.js"]
    for name, recorded in rows:
        assert hashlib.sha256((APP / name).read_bytes()).hexdigest() == recorded
    assert "Apache License" in (APP / "LICENSE-htm.txt").read_text(encoding="utf-8")
    assert "MIT License" in (APP / "LICENSE-preact.txt").read_text(encoding="utf-8")


def test_the_page_is_small_and_names_no_other_host() -> None:
    own = {name: content for name, content in page_files().items() if "LICENSE" not in name}
    assert sum(map(len, own.values())) <= MOST_BYTES
    for name, content in own.items():
        hosts = set(re.findall(rb"(?:https?:)?//([a-z0-9-]+\.[a-z]{2,}[a-z0-9.-]*)", content))
        assert hosts <= {b"www.w3.org"}, name


def test_the_page_runs_its_own_scripts_only() -> None:
    page = page_files()["index.html"].decode()
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page)
    assert policy
    assert "default-src 'none'" in policy[1]
    assert "unsafe" not in policy[1]
    scripts = re.findall(r"<script([^>]*)>(.*?)</script>", page)
    assert scripts
    assert all(re.fullmatch(r' src="app/[a-z-]+\.js"', source) and not body for source, body in scripts)
    assert {re.search(r"app/[\w.-]+", source)[0] for source, _ in scripts} == {
        name for name in page_files() if name.endswith(".js")
    }
    for name, content in page_files().items():
        assert not re.search(rb"innerHTML|\beval\(|new Function\(|document\.write", content) or "preact" in name, (
            name
        )


def test_options_of_an_export_need_its_folder(little_runs: Path) -> None:
    done = CliRunner().invoke(app, ["view", str(little_runs / "run"), "--without-frames"])
    assert done.exit_code == 2
    assert "give --export FOLDER" in done.stderr
