"""A family of a third party that is installed: no command imports it, or torch, that does not need it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from probe_kit.runs import Run
from probe_kit.suite import Suite
from tests.support.distributions import install

HEAVY = """
import torch
from probe_kit.hooks import Family

FAMILY = Family("heavy-vla", "imports torch", None, "heavy_vla:load", needs_checkpoint=True)
"""
BROKEN = "raise SystemExit('not today')\n"
EACH = """
import sys
from typer.testing import CliRunner
from probe_kit.cli import app

for line in sys.stdin.read().splitlines():
    done = CliRunner().invoke(app, line.split("\\t"))
    print(done.exit_code, [name for name in ("torch", "heavy_vla", "broken_vla") if name in sys.modules])
print(CliRunner().invoke(app, ["models"]).stdout)
"""


@pytest.mark.slow
def test_no_command_that_needs_no_model_imports_torch_or_a_third_party(
    recorded_run: Run, small_suite: Suite, tmp_path: Path
) -> None:
    """One process runs all commands, as each would be run."""
    for name, text in (("heavy", HEAVY), ("broken", BROKEN)):
        folder = install(tmp_path / name, f"{name}-vla", f"{name}_vla:FAMILY")
        (folder / f"{name}_vla.py").write_text(text, encoding="utf-8")
    suite, run = str(small_suite.folder), str(recorded_run.path)
    commands = [
        ("--help",), ("models",), ("models", "--json"), ("models", "pi0-tiny"), ("extract", "--help"),
        ("suite", "show", "--counts", suite), ("suite", "show", suite),
        ("run", "show", run), ("run", "verify", run),
        ("extract", "--model", "no-such-model", "--dry-run"), ("new-adapter", "heavy-vla"),
    ]  # fmt: skip
    paths = [str(tmp_path / "heavy"), str(tmp_path / "broken"), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, "-c", EACH], input="\n".join("\t".join(one) for one in commands), cwd=tmp_path,
        capture_output=True, encoding="utf-8", check=True, timeout=300,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
    )  # fmt: skip
    answers = done.stdout.splitlines()
    expected = [0] * (len(commands) - 2) + [2, 2]
    assert answers[: len(commands)] == [f"{code} []" for code in expected], done.stdout + done.stderr
    listed = [line.split()[0] for line in answers[len(commands) :] if line]
    assert {"heavy-vla", "broken-vla", "pi0-tiny"} <= set(listed)
    assert "BrokenFamilyWarning" not in done.stderr
