"""Exports and copies on a full disk: an error that names it, no signal, and nothing that stops the next."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from probe_kit._system.drafts import full_disk_in_words
from probe_kit.errors import DiskSpaceError


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 8 kB, less than any export needs."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8k", "none", str(disk)]
    try:
        mounted = subprocess.run(mount, capture_output=True, encoding="utf-8", check=False)
    except FileNotFoundError:
        pytest.skip("there is no command `mount` here")
    if mounted.returncode != 0:
        pytest.skip(f"cannot mount a small tmpfs here: {mounted.stderr.strip()}")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize(
    "words",
    ["export --format h5"]
    + [
        pytest.param(words, marks=pytest.mark.slow)
        for words in ("export --format sae", "export --format safetensors", "export --format parquet", "copy")
    ],
)
def test_a_full_disk_is_named_and_nothing_is_left(little_runs: Path, full_disk: Path, words: str) -> None:
    name, *options = words.split()
    out = ["--out", str(full_disk / "out")] if name == "export" else [str(full_disk / "out")]
    command = [sys.executable, "-m", "probe_kit", "run", name, str(little_runs / "run"), *options, *out]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == DiskSpaceError.exit_code, done.stderr
    assert "DiskSpaceError" in done.stderr
    assert "is full; nothing was written there" in " ".join(done.stderr.split())
    assert list(full_disk.iterdir()) == []
    subprocess.run(["mount", "-o", "remount,size=40m", str(full_disk)], check=True)
    again = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
    assert again.returncode == 0, again.stderr


def test_an_error_of_a_part_of_a_draft_names_the_path_that_was_requested(tmp_path: Path) -> None:
    path = tmp_path / "study.zip"
    message = r"disk of \S*/study\.zip is full; nothing was written"
    with pytest.raises(DiskSpaceError, match=message), full_disk_in_words(path):
        raise DiskSpaceError(f"the disk of {tmp_path}/.study.zip.abc.tmp/pack/runs/a is full")
