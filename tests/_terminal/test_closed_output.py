"""A command whose output has no reader, or nowhere to go, ends without a traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMANDS = (
    ("--help",), ("--version",), ("models",), ("models", "--json"), ("run", "show", "{run}"),
    ("run", "show", "{run}", "--json"), ("run", "verify", "{run}"), ("retention", "{run}"),
    ("retention", "{run}", "--format", "json"), ("retention", "{run}", "--format", "csv"), ("suite", "list"),
    ("study", "run", "embedded", "--dry-run"),
)  # fmt: skip


def run_command(words: tuple[str, ...], run: Path, redirection: str) -> subprocess.CompletedProcess[str]:
    command = " ".join([sys.executable, "-m", "probe_kit", *(word.format(run=run) for word in words)])
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        ["bash", "-c", f"{command} {redirection}"],
        capture_output=True,
        encoding="utf-8",
        env=environment,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.parametrize("redirection", ["| true", "| head -c 1", ">&-", ">&- 2>&-", "> /dev/full"])
@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_no_command_ends_in_a_traceback(little_runs: Path, words: tuple[str, ...], redirection: str) -> None:
    done = run_command(words, little_runs / "run", redirection)
    assert "Traceback" not in done.stderr
    assert "InternalError" not in done.stderr
    assert "Exception ignored" not in done.stderr


@pytest.mark.parametrize(
    "redirection",
    ["| true", pytest.param(">&-", marks=pytest.mark.slow), pytest.param("> /dev/full", marks=pytest.mark.slow)],
)
def test_a_table_without_a_reader_ends_without_a_traceback(little_runs: Path, redirection: str) -> None:
    test_no_command_ends_in_a_traceback(little_runs, ("retention", "{run}"), redirection)
