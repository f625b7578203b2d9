"""Who may read a run is decided by the umask of the process that writes it."""

import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.suite import Suite
from tests.support.little_run import intervene_on_little_run, probe_little_run, write_little_run


@pytest.fixture(
    params=[pytest.param(0o002, marks=pytest.mark.slow), 0o027, pytest.param(0o077, marks=pytest.mark.slow)],
    ids=oct,
)
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    mask: int = request.param
    before = os.umask(mask)
    yield mask
    os.umask(before)


@pytest.mark.slow
def test_files_and_folders_of_runs_copies_and_exports_follow_the_umask(
    small_suite: Suite, tmp_path: Path, umask: int
) -> None:
    made = write_little_run(tmp_path / "made" / "run", small_suite.select(["color"]), 0)
    probe_little_run(made)
    intervene_on_little_run(made)
    run = str(tmp_path / "made" / "run")
    for command in (
        ["run", "copy", run, str(tmp_path / "made" / "copy")],
        ["run", "export", run, "--format", "safetensors", "--out", str(tmp_path / "made" / "run.safetensors")],
        ["run", "export", run, "--format", "sae", "--out", str(tmp_path / "made" / "sae")],
        ["run", "export", run, "--format", "h5", "--out", str(tmp_path / "made" / "run.h5")],
        ["view", run, "--export", str(tmp_path / "made" / "page")],
    ):
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 0, done.output
    entries = sorted((tmp_path / "made").rglob("*"))
    assert len(entries) > 40
    others = {
        str(entry.relative_to(tmp_path)): oct(stat.S_IMODE(entry.stat().st_mode))
        for entry in entries
        if stat.S_IMODE(entry.stat().st_mode) != (0o777 if entry.is_dir() else 0o666) & ~umask
    }
    assert not others
