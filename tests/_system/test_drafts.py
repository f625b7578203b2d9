"""Drafts: what is written appears whole or not at all, and the next one clears what a killed process left."""

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from probe_kit._system.drafts import draft_of, write_whole
from probe_kit.runs import open_run
from probe_kit.runs.export import export_run
from probe_kit.suite import build_suite

DYING = """
import os, signal, sys
from pathlib import Path
from probe_kit._system.drafts import draft_of
with draft_of(Path(sys.argv[1])) as draft:
    draft.write_text("half", encoding="utf-8")
    os.kill(os.getpid(), signal.SIGKILL)
"""
LIVING = """
import sys
from pathlib import Path
from probe_kit._system.drafts import draft_of
with draft_of(Path(sys.argv[1])) as draft:
    draft.write_text("theirs", encoding="utf-8")
    print("ready", flush=True)
    sys.stdin.readline()
    draft.replace(sys.argv[1])
"""


def leave_a_draft(path: Path) -> None:
    """As a process does that is killed while it makes one."""
    assert subprocess.run([sys.executable, "-c", DYING, str(path)], check=False).returncode == -signal.SIGKILL
    assert len(list(path.parent.glob(f".{path.name}.*.tmp"))) == 1


def write_text(path: Path) -> None:
    write_whole(path, "whole")


def draw_suite(path: Path) -> None:
    build_suite(path, ["color"], 2)


@pytest.mark.parametrize("make", [write_text, draw_suite])
def test_what_a_killed_process_left_is_removed_by_the_next(make: Callable[[Path], None], tmp_path: Path) -> None:
    path = tmp_path / "made"
    leave_a_draft(path)
    assert not path.exists()
    make(path)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
def test_an_export_that_was_killed_is_removed_by_the_next(little_runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "run.safetensors"
    leave_a_draft(out)
    export_run(open_run(little_runs / "run").location, "safetensors", out)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.safetensors", "run.safetensors.sha256"]


def test_the_draft_of_a_living_process_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "made"
    command = [sys.executable, "-c", LIVING, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, encoding="utf-8") as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "ready\n"
        write_whole(path, "ours")
        assert path.read_text(encoding="utf-8") == "ours"
        other.communicate("\n")
    assert other.returncode == 0
    assert path.read_text(encoding="utf-8") == "theirs"
    assert list(tmp_path.iterdir()) == [path]


def test_a_text_that_cannot_be_finished_leaves_the_former_one(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    write_whole(path, "former")
    with pytest.raises(UnicodeEncodeError):
        write_whole(path, "new \ud800")
    assert path.read_text(encoding="utf-8") == "former"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_in_the_body_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        with draft_of(tmp_path / "made") as draft:
            draft.write_text("half", encoding="utf-8")
            raise ValueError("no more")

    with pytest.raises(ValueError, match="no more"):
        fail()
    assert list(tmp_path.iterdir()) == []
