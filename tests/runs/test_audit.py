import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from probe_kit.errors import RunDamagedError, RunNotFoundError
from probe_kit.runs import Run, open_run, verify_run


@pytest.fixture
def damaged(recorded_run: Run, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(recorded_run.path, tmp_path / "run"))


def flip_a_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def an_object(run: Path, array: str, episode: int) -> Path:
    return next(path for path in sorted((run / f"data.zarr/{array}/c/{episode}").rglob("*")) if path.is_file())


def test_an_untouched_run_is_whole(recorded_run: Run) -> None:
    found = verify_run(recorded_run.path, deep=True)
    assert found.ok
    assert (found.committed, found.planned, found.failed, found.sealed) == (48, 48, 0, True)


def test_a_flipped_bit_is_found_by_reading_every_byte(damaged: Path) -> None:
    flip_a_bit(an_object(damaged, "expert/tokens", 7))
    assert verify_run(damaged).ok
    (problem,) = verify_run(damaged, deep=True).problems
    assert "data.zarr/expert/tokens/c/7" in problem
    assert "Delete commits/00000007.json" in problem


def test_a_missing_and_a_truncated_object_are_found_by_size(damaged: Path) -> None:
    an_object(damaged, "backbone/pooled", 3).unlink()
    shard = an_object(damaged, "backbone/tokens", 9)
    shard.write_bytes(shard.read_bytes()[:-1])
    first, second = verify_run(damaged).problems
    assert "is missing" in first
    assert "were written" in second


def test_a_changed_outcome_is_found(damaged: Path) -> None:
    commit = damaged / "commits/00000002.json"
    content = json.loads(commit.read_text(encoding="utf-8"))
    content["outcome"]["outcome"] = "correct"
    commit.write_text(json.dumps(content), encoding="utf-8")
    (problem,) = verify_run(damaged).problems
    assert "commits/00000002.json was changed after it was written" in problem
    with pytest.raises(RunDamagedError, match=r"commits/00000002\.json was changed"):
        open_run(damaged)


def test_changed_settings_are_found(damaged: Path) -> None:
    card = damaged / "run.json"
    card.write_text(card.read_text(encoding="utf-8").replace('"seed": 0', '"seed": 1'), encoding="utf-8")
    assert "hash" in verify_run(damaged).problems[0]


def test_a_flipped_bit_in_the_columns_is_found(damaged: Path) -> None:
    flip_a_bit(next(p for p in sorted((damaged / "columns.zarr/expert/pooled/c").rglob("*")) if p.is_file()))
    assert "--seal" in verify_run(damaged, deep=True).problems[0]


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunNotFoundError):
        verify_run(tmp_path)


@pytest.mark.slow
def test_the_command_reports_and_exits_with_1(damaged: Path) -> None:
    flip_a_bit(an_object(damaged, "backbone/pooled", 0))
    command = [sys.executable, "-m", "probe_kit", "run", "verify", str(damaged), "--deep", "--json"]
    answer = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
    assert answer.returncode == 1, answer.stderr
    assert json.loads(answer.stdout)["ok"] is False
    command = [*command[:-2]]
    assert subprocess.run(command, capture_output=True, check=False).returncode == 0
