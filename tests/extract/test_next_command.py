"""`probe-kit extract` ends on a command that works on what it stored."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.suite import Suite


@pytest.mark.slow
@pytest.mark.parametrize(
    ("items", "command"), [(4, "retention"), pytest.param(10, "train", marks=pytest.mark.slow)]
)
def test_probes_are_only_the_next_step_of_as_many_groups_as_they_have_folds(
    items: int, command: str, small_suite: Suite, tmp_path: Path
) -> None:
    few = ("--categories", "color", "--items", str(items), "--suite", str(small_suite.folder))
    fast = ("--no-act", "--env-workers", "0", "--out", str(tmp_path / "run"))
    result = CliRunner().invoke(app, ["extract", "--model", "pi0-tiny", *few, *fast])
    assert result.exit_code == 0, result.output
    assert f"next: probe-kit {command} {tmp_path / 'run'}" in " ".join(result.stderr.split())
