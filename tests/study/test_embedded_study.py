"""The embedded study of the package, from nothing to all tables, and once more."""

import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import pytest

from probe_kit.study import load_study, make_table


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "probe_kit", "study", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )


def stored(folder: Path) -> dict[Path, tuple[int, int]]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in files}


@pytest.mark.slow
def test_the_embedded_study_runs_to_all_tables_and_again_without_a_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    played = command(tmp_path, "run", "embedded", "--slots", "2")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert played.returncode == 0, played.stderr[-3000:]
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{time.monotonic() - began:.0f} s, {cpu:.0f} CPU seconds, load {os.getloadavg()[0]:.1f}")
    files = stored(tmp_path)
    again = command(tmp_path, "run", "embedded")
    assert again.returncode == 0, again.stderr[-3000:]
    assert "missing: 0 episodes" in again.stdout
    assert not [line for line in again.stderr.splitlines() if line.split("|")[-1].strip() == "torch"]
    assert stored(tmp_path) == files
    assert command(tmp_path, "run", "embedded", "--dry-run", "--exit-code").returncode == 0
    monkeypatch.chdir(tmp_path)
    study = load_study("embedded")
    for name in study.study.tables:
        assert make_table(study, name).numbers, name
