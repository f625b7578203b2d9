"""Crashes: killed and resumed equals never killed."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from probe_kit.errors import DiskSpaceError
from probe_kit.runs import open_run, verify_run
from probe_kit.runs.store import locate
from probe_kit.suite import Suite, build_suite
from tests.runs.contents import hashes

ROOT = Path(__file__).parents[2]
KILLING = ("-m", "tests.runs.killing")


def start(run: Path, suite: Suite, *point: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, *KILLING, str(run), str(suite.folder), *point], cwd=ROOT)


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suite") / "six", ["color"], 6)


@pytest.fixture(scope="module")
def whole(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An undisturbed run."""
    run = tmp_path_factory.mktemp("whole") / "run"
    assert start(run, suite).wait() == 0
    return run


@pytest.mark.parametrize(
    "point",
    [
        "before-commit",
        *(pytest.param(point, marks=pytest.mark.slow) for point in ("after-commit", "before-put", "after-put")),
    ],
)
def test_a_kill_at_any_point_of_an_episode_costs_at_most_that_episode(
    point: str, suite: Suite, whole: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    assert start(run, suite, point).wait() == -signal.SIGKILL
    committed = 3 if point == "after-commit" else 2
    assert len(open_run(run, allow_partial=True).episodes) == committed
    assert verify_run(run, deep=True).ok
    assert start(run, suite).wait() == 0
    assert hashes(run) == hashes(whole)


@pytest.mark.slow
def test_leftovers_of_a_killed_process_are_cleared_by_the_next_owner(
    suite: Suite, whole: Path, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(whole, tmp_path / "run"))
    aside = ("commits", "times", "failed", "certificates", "provenance", "sealed", "frames", "videos")
    data = ("data.zarr/backbone/pooled/c/0/x.partial", "columns.zarr/x/zarr.json")
    for orphan in (*(f"{folder}/abc.tmp" for folder in aside), *data):
        (run / orphan).parent.mkdir(parents=True, exist_ok=True)
        (run / orphan).write_text("torn", encoding="utf-8")
    assert start(run, suite).wait() == 0
    assert hashes(run) == hashes(whole)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 700 kB, about half of what the run needs."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=700k", "none", str(disk)],
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    if mounted.returncode != 0:
        pytest.skip(f"cannot mount a small tmpfs here: {mounted.stderr.strip()}")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="mounts a tmpfs")
def test_a_full_disk_is_named_and_leaves_a_store_that_resumes(suite: Suite, whole: Path, small_disk: Path) -> None:
    run = small_disk / "run"
    process = subprocess.run(
        [sys.executable, *KILLING, str(run), str(suite.folder)],
        cwd=ROOT,
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert "is full" in process.stderr
    found = verify_run(run, deep=True)
    assert found.ok
    assert 0 < found.committed < 12
    assert not list(run.rglob("*.tmp"))
    subprocess.run(["mount", "-o", "remount,size=20m", str(small_disk)], check=True)
    assert start(run, suite).wait() == 0
    assert hashes(run) == hashes(whole)


def test_other_errors_of_the_disk_keep_their_name(tmp_path: Path) -> None:
    with pytest.raises(PermissionError), locate(tmp_path).in_words():
        raise PermissionError
    with pytest.raises(DiskSpaceError), locate(tmp_path).in_words():
        raise OSError(28, "No space left on device")
