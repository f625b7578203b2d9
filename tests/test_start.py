"""Ctrl-C and SIGTERM end the command in one line and with 130, wherever in its start they fall."""

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from probe_kit.suite import Suite

INTERRUPTING = """
import os, runpy, signal, sys

signal.signal(signal.SIGINT, signal.default_int_handler)

at, number, how, place, *sys.argv[1:] = sys.argv[1:]

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == at:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), int(number))

sys.meta_path.insert(0, Interrupt())
(runpy.run_path if how == "script" else runpy.run_module)(place, run_name="__main__")
"""
SCRIPT = shutil.which("probe-kit", path=str(Path(sys.executable).parent))


def interrupted(at: str, how: str, number: signal.Signals, *words: str) -> subprocess.CompletedProcess[str]:
    """The command, interrupted when it begins to import the module `at`."""
    target = SCRIPT if how == "script" else "probe_kit"
    command = [sys.executable, "-c", INTERRUPTING, at, str(int(number)), how, str(target), *words]
    return subprocess.run(command, capture_output=True, encoding="utf-8", check=False, timeout=120)


@pytest.mark.parametrize(
    ("at", "how", "number"),
    [
        ("probe_kit.cli", "module", signal.SIGINT),
        ("rich.console", "script", signal.SIGINT),
        ("probe_kit.train.power_commands", "module", signal.SIGTERM),
    ],
)
def test_before_a_command_begins_nothing_is_lost_and_nothing_is_traced(
    at: str, how: str, number: signal.Signals
) -> None:
    if how == "script" and SCRIPT is None:
        pytest.skip("the console script is not installed")
    completed = interrupted(at, how, number, "models")
    assert (completed.returncode, completed.stdout) == (130, "")
    assert completed.stderr == "interrupted before anything was begun\n"


@pytest.mark.slow
def test_while_a_command_imports_its_libraries_it_says_that_what_is_finished_is_kept(
    small_suite: Suite, tmp_path: Path
) -> None:
    words = ["extract", "--model", "pi0-tiny", "--random-weights", "--items", "2", "--dry-run"]
    words += ["--suite", str(small_suite.folder), "--out", str(tmp_path / "run")]
    completed = interrupted("torch", "module", signal.SIGINT, *words)
    assert (completed.returncode, completed.stdout) == (130, "")
    assert completed.stderr == "interrupted. Completed work is saved; run the same command to resume.\n"


def test_what_a_shell_runs_in_the_background_still_ignores_ctrl_c() -> None:
    code = "import signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); sys.argv[1:] = ['--version'];"
    code += "from probe_kit.__main__ import main; import os; os.kill(os.getpid(), signal.SIGINT); main()"
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=False)
    assert completed.returncode == 0
    assert completed.stdout.startswith("probe-kit ")
