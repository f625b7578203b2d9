"""The failures of a study: what is stored of them, and what a plan makes of them and of former runs."""

import re
from pathlib import Path

import pytest

from probe_kit.errors import RunDamagedError
from probe_kit.study import Failure, conduct_study, load_study, plan_study
from probe_kit.study.cells import Cell, Failures
from probe_kit.suite import Suite
from tests.study.broken_files import BASE
from tests.study.small_study import SCRIPTED, small_study

FAILURE = Failure(stage="playing", model="base", run="base/dark", reason="no memory", when="noon")


@pytest.fixture
def study_file(tmp_path: Path) -> Path:
    file = tmp_path / "study.toml"
    file.write_text(BASE.replace("runs/small", str(tmp_path / "out")), encoding="utf-8")
    return file


@pytest.fixture
def cell(study_file: Path) -> Cell:
    return next(cell for cell in load_study(study_file).cells if cell.name == "base/dark")


@pytest.fixture
def failures(tmp_path: Path) -> Failures:
    return Failures(str(tmp_path / "out"))


def test_a_failure_is_stored_once_and_cleared(cell: Cell, failures: Failures, tmp_path: Path) -> None:
    assert failures.of(cell) is None
    failures.note(cell, FAILURE)
    (file,) = (tmp_path / "out" / "failures").iterdir()
    assert file.name == f"base+dark-{cell.key}.json"
    before = file.stat()
    failures.note(cell, FAILURE.model_copy(update={"when": "later"}))
    assert (file.stat().st_ino, file.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    failures.note(cell, FAILURE.model_copy(update={"stage": "probes"}), "main")
    assert FAILURE.same(failures.of(cell))
    failures.clear(cell)
    assert failures.of(cell) is None
    assert failures.of(cell, "main") is not None


def test_what_a_killed_process_left_aside_is_removed(cell: Cell, failures: Failures, tmp_path: Path) -> None:
    failures.note(cell, FAILURE)
    draft = tmp_path / "out" / "failures" / "left.tmp"
    draft.touch()
    failures.check_place()
    assert not draft.exists()


@pytest.mark.parametrize("content", ["", "[]", '{"run": 1}', '{"run": "base/dark"}'])
def test_a_record_that_is_none_is_named(cell: Cell, failures: Failures, tmp_path: Path, content: str) -> None:
    failures.note(cell, FAILURE)
    (file,) = (tmp_path / "out" / "failures").iterdir()
    file.write_text(content, encoding="utf-8")
    with pytest.raises(RunDamagedError, match=rf"{re.escape(file.name)} .*Delete it; no number"):
        failures.of(cell)


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


def test_a_plan_names_failures_and_what_waits_for_them(study_file: Path, cell: Cell, failures: Failures) -> None:
    failures.note(cell, FAILURE)
    states = {
        planned.cell.name: (planned.state, planned.why) for planned in plan_study(load_study(study_file)).cells
    }
    assert states["base/dark"] == ("failed", "failed (noon): no memory")
    assert states["base/plain"] == ("waiting", "new; waits, because base/dark failed")
    assert states["state/plain"] == ("new", "new")
    failures.note(cell, FAILURE.model_copy(update={"stage": "episodes"}))
    assert whys(study_file)["base/plain"] == "new"


def test_a_failure_of_former_settings_is_none(study_file: Path, cell: Cell, failures: Failures) -> None:
    failures.note(cell, FAILURE)
    text = study_file.read_text(encoding="utf-8")
    study_file.write_text(text.replace("light_level = 0.7", "light_level = 0.6"), encoding="utf-8")
    assert whys(study_file)["base/dark"] == "new"


def whys(file: Path) -> dict[str, str]:
    return {planned.cell.name: planned.why for planned in plan_study(load_study(file)).cells}


@pytest.mark.slow
def test_a_plan_says_what_changed_since_a_run_of_the_same_name(small_suite: Suite, tmp_path: Path) -> None:
    file = small_study(tmp_path, small_suite, SCRIPTED, items=6)
    assert conduct_study(plan_study(load_study(file)), env_workers=0) == []
    assert set(whys(file).values()) == {"whole"}
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("light_level = 0.7", "light_level = 0.6"), encoding="utf-8")
    expected = {"plain": "whole", "dark": "new: light_level 0.7 → 0.6"}
    assert whys(file) == {f"{model}/{way}": why for model in ("expert", "idle") for way, why in expected.items()}
