"""The ledger: what it keeps, when it is written, and what it says of changed settings."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from probe_kit.errors import RunDamagedError
from probe_kit.study import Failure, Ledger, load_study, plan_study
from probe_kit.study.cells import Cell
from probe_kit.study.ledger import Played, Speed, settings_changed
from probe_kit.study.tables.stored_runs import noted_run
from tests.study.broken_files import BASE

PLAYED = Played(episodes=4, settings_sha256="a", weights_sha256=None, provenance=[{"device": "cpu"}], seconds=0.5)


@pytest.fixture
def study_file(tmp_path: Path) -> Path:
    file = tmp_path / "study.toml"
    file.write_text(BASE.replace("runs/small", str(tmp_path / "out")), encoding="utf-8")
    return file


@pytest.fixture
def cell(study_file: Path) -> Cell:
    return next(cell for cell in load_study(study_file).cells if cell.name == "base/dark")


def test_a_record_is_read_back_and_is_written_only_when_it_changes(cell: Cell, tmp_path: Path) -> None:
    ledger = Ledger(str(tmp_path / "out"))
    assert (ledger.entries(), ledger.of(cell).played) == ({}, None)
    ledger.note(cell, played=PLAYED)
    (file,) = (tmp_path / "out" / "ledger").iterdir()
    assert file.name == f"base+dark-{cell.key}.json"
    before = file.stat()
    ledger.note(cell, played=PLAYED)
    assert (file.stat().st_ino, file.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    assert ledger.entries() == {file.stem: ledger.of(cell)}
    assert (ledger.of(cell).played, ledger.of(cell).settings) == (PLAYED, cell.known)


def test_what_a_killed_process_left_aside_is_removed(cell: Cell, tmp_path: Path) -> None:
    ledger = Ledger(str(tmp_path / "out"))
    ledger.note(cell, played=PLAYED)
    left = tmp_path / "out" / "ledger" / "left.tmp"
    left.touch()
    ledger.note(cell, played=PLAYED)
    assert not left.exists()


@pytest.mark.parametrize("content", ["", "[]", '{"cell": 1}', '{"cell": "base/dark"}'])
def test_a_record_that_is_none_is_named(cell: Cell, tmp_path: Path, content: str) -> None:
    ledger = Ledger(str(tmp_path / "out"))
    ledger.note(cell, played=PLAYED)
    (file,) = (tmp_path / "out" / "ledger").iterdir()
    file.write_text(content, encoding="utf-8")
    with pytest.raises(RunDamagedError, match=rf"{re.escape(file.name)} .*Delete it; no number"):
        ledger.entries()


def test_a_failure_has_its_traceback_and_equals_the_same_one_later() -> None:
    def failed() -> Failure:
        try:
            raise ValueError("no such layer")
        except ValueError as error:
            return Failure.of("playing", "base", "base/dark", error)

    failure, again = failed(), failed()
    assert str(failure) == "base failed at base/dark: no such layer"
    assert "in failed\n" in failure.traceback
    assert failure.error == "ValueError"
    assert failure.same(again.model_copy(update={"when": "later", "traceback": ""}))
    assert not failure.same(again.model_copy(update={"reason": "another layer"}))
    assert not failure.same(None)


def test_changed_settings_are_named_by_their_innermost_key() -> None:
    before = {"scene": {"light_level": 1.0, "light": {"ambient": 0.45}}, "seed": 0, "wordings": ["knowledge"]}
    after = {"scene": {"light_level": 0.7, "light": {"ambient": 0.45}}, "seed": 0, "wordings": None}
    assert settings_changed(before, after) == ["light_level 1 → 0.7", "wordings ['knowledge'] → none"]
    assert settings_changed(before, before) == []
    files = [[["a.json", 4, 1], ["b", 5, 1]], [["a.json", 4, 1], ["b", 5, 2], ["c", 1, 1]]]
    before, after = ({"checkpoint": one} for one in files)
    assert settings_changed(before, after) == ["checkpoint: b, c changed"]
    assert settings_changed({"checkpoint": "owner/name"}, after) == ["checkpoint owner/name → 3 files"]


def test_two_settings_of_one_innermost_name_are_told_apart() -> None:
    before = {"camera": {"width": 640}, "picture": {"width": 224}}
    after = {"camera": {"width": 320}, "picture": {"width": 224}}
    assert settings_changed(before, after) == ["width 640 → 320"]


def test_a_plan_says_what_changed_since_a_run_of_the_same_name(
    study_file: Path, cell: Cell, tmp_path: Path
) -> None:
    Ledger(str(tmp_path / "out")).note(cell, played=PLAYED)
    assert whys(study_file)["base/dark"] == "new"  # the folder was deleted
    text = study_file.read_text(encoding="utf-8")
    study_file.write_text(text.replace("light_level = 0.7", "light_level = 0.6"), encoding="utf-8")
    assert whys(study_file)["base/dark"] == "new: light_level 0.7 → 0.6"
    assert whys(study_file)["base/plain"] == "new"


def whys(file: Path) -> dict[str, str]:
    return {one.cell.name: one.why for one in plan_study(load_study(file)).cells}


def test_a_plan_names_failures_and_what_waits_for_them(study_file: Path, cell: Cell, tmp_path: Path) -> None:
    failure = Failure(stage="playing", model="base", run="base/dark", reason="no memory", when="noon")
    Ledger(str(tmp_path / "out")).note(cell, failure=failure)
    states = {one.cell.name: (one.state, one.why) for one in plan_study(load_study(study_file)).cells}
    assert states["base/dark"] == ("failed", "failed (noon): no memory")
    assert states["base/plain"] == ("waiting", "new; waits, because base/dark failed")
    assert states["state/plain"] == ("new", "new")
    Ledger(str(tmp_path / "out")).note(cell, failure=failure.model_copy(update={"stage": "episodes"}))
    assert whys(study_file)["base/plain"] == "new"


def test_a_run_is_found_where_an_equal_one_serves_it(study_file: Path, cell: Cell, tmp_path: Path) -> None:
    study = load_study(study_file)
    out = str(tmp_path / "out")
    assert str(noted_run(study, cell)[0]) == cell.location(out)
    Ledger(out).note(cell, played=PLAYED.model_copy(update={"served_by": "elsewhere"}))
    assert str(noted_run(study, cell)[0]) == "elsewhere"
    assert str(noted_run(study, replace(cell, seed=1))[0]).startswith(f"{out}/base/dark-seed1-")


@pytest.mark.parametrize("change", ["served_by", "renamed", "exchanged"])
def test_a_record_that_was_changed_or_is_another_cells_leads_nowhere(
    study_file: Path, cell: Cell, tmp_path: Path, change: str
) -> None:
    ledger = Ledger(str(tmp_path / "out"))
    ledger.note(cell, played=PLAYED)
    other = next(one for one in load_study(study_file).cells if one.name == "base/plain")
    ledger.note(other, played=PLAYED)
    folder = tmp_path / "out" / "ledger"
    file, theirs = folder / f"base+dark-{cell.key}.json", folder / f"base+plain-{other.key}.json"
    if change == "served_by":
        file.write_bytes(file.read_bytes().replace(b'"served_by": ""', b'"served_by": "/elsewhere"'))
    elif change == "renamed":
        theirs.replace(file)
    else:
        ours = file.read_bytes()
        file.write_bytes(theirs.read_bytes())
        theirs.write_bytes(ours)
    with pytest.raises(RunDamagedError, match=rf"{re.escape(file.name)} .*Delete it; no number comes from it"):
        ledger.of(cell)


def test_speeds_are_kept_per_machine(tmp_path: Path) -> None:
    ledger = Ledger(str(tmp_path / "out"))
    speed = Speed(seconds=0.1, bytes=10, batch=1, device="cpu", tokens="pooled", episodes=8)
    ledger.note_speed("base, acting", speed)
    ledger.note_speed("reader, asked", speed)
    assert ledger.speeds() == {"base, acting": speed, "reader, asked": speed}
    assert ledger.entries() == {}
    (file,) = (tmp_path / "out" / "ledger" / "speeds").iterdir()
    file.rename(file.with_name("other.json"))
    assert ledger.speeds() == {}
