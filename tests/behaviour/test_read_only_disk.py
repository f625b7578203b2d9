"""A disk that can be read and not written: readers work, writers say so with exit code 3 and change nothing."""

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.runs import verify_run
from probe_kit.suite import Suite
from tests.support.reading import readings


def mount(*arguments: str) -> None:
    done = subprocess.run(["mount", *arguments], capture_output=True, encoding="utf-8", check=False)
    if done.returncode != 0:
        pytest.skip(f"cannot mount here: {done.stderr.strip()}")


@pytest.fixture(scope="module")
def disk(little_runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A real file system, mounted read-only, with a whole run and one without columns on it."""
    place = tmp_path_factory.mktemp("disk")
    if shutil.which("mount") is None:
        pytest.skip("there is no mount here")
    mount("-t", "tmpfs", "-o", "size=50m", "none", str(place))
    try:
        shutil.copytree(little_runs / "run", place / "run")
        shutil.copytree(
            little_runs / "run", place / "bare", ignore=shutil.ignore_patterns("columns.zarr", "sealed")
        )
        mount("-o", "remount,ro", str(place))
        yield place
    finally:
        subprocess.run(["umount", str(place)], check=True)


def test_a_run_on_a_read_only_disk_is_read_and_verified(disk: Path, little_runs: Path) -> None:
    assert verify_run(disk / "run", deep=True).ok
    assert readings(disk / "run") == readings(little_runs / "run")
    assert CliRunner().invoke(app, ["run", "show", str(disk / "run")]).exit_code == 0


@pytest.mark.parametrize(
    "command",
    [
        "extract --model expert --items 2 --suite {suite} --out {}/new",
        "run verify {}/bare --seal",
        "train {}/run --permutations 7",
    ],
    ids=lambda command: command.split(" -")[0].split(" {")[0],
)
def test_whatever_writes_there_says_that_the_disk_is_read_only(
    disk: Path, command: str, small_suite: Suite
) -> None:
    answer = CliRunner().invoke(app, command.format(disk, suite=small_suite.folder).split())
    assert answer.exit_code == 3, answer.output
    assert "is read-only" in " ".join(answer.output.split())
    assert "Traceback" not in answer.output
    assert {path.name for path in disk.iterdir()} == {"run", "bare"}
