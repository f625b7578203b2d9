"""Atomic writes: files and folders are written beside their final place and renamed when complete."""

import errno
import fcntl
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from probe_kit.errors import FULL_DISK, DiskSpaceError, UsageError

_SUFFIX = ".tmp"
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]+:")
"""The first part of a path that was a URL: `s3://bucket/file` is the path `s3:/bucket/file`."""


@contextmanager
def draft_of(path: Path) -> Iterator[Path]:
    """Yield a path for a draft of the file or folder `path`; the body renames it when it is whole.

    After the body the draft is gone. It lies in a hidden folder beside `path`, `.<name>.<letters>.tmp`, which is
    locked as long as its process lives. Drafts that killed processes left for the same `path` are removed first.

    Raises:
        UsageError: For a path that was a URL, which would become a folder of that name in the working folder.
    """
    top = path.parts[0] if len(path.parts) > 1 else ""
    if _SCHEME.fullmatch(top) and not Path(top).exists():
        raise UsageError(
            f"{path} was a URL before it became a path; files are written to folders of this machine. Give such a "
            "path, and copy the result to its store afterwards"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_abandoned(path)
    with _own_folder(path) as folder:
        yield folder / path.name


def write_whole(path: Path, text: str) -> None:
    """Write a text in UTF-8 in place of what is there: readers find the former text or all of this one."""
    with draft_of(path) as draft:
        draft.write_text(text, encoding="utf-8", newline="\n")
        draft.replace(path)


def move_draft(draft: Path, path: Path) -> None:
    """Give a whole draft its name, or raise UsageError if something else lies there by now."""
    if path.is_dir() and not any(path.iterdir()):
        path.rmdir()  # nothing is lost, and a file takes its place as well
    if path.exists():
        raise UsageError(f"{path} exists; choose another path or remove it")
    draft.rename(path)


@contextmanager
def full_disk_in_words(path: Path) -> Iterator[None]:
    """Raise DiskSpaceError in place of the system's error where the disk of `path` takes no more."""
    try:
        yield
    except DiskSpaceError as error:  # of a part of the same draft, which the caller cannot know
        if _prefix(path) not in str(error):
            raise
        raise _full(path, errno.ENOSPC) from error
    except OSError as error:
        if error.errno not in FULL_DISK:
            raise
        raise _full(path, error.errno) from error


def _full(path: Path, number: int) -> DiskSpaceError:
    return DiskSpaceError(
        f"the disk of {path} {FULL_DISK[number]}; nothing was written there. Free some space or choose another "
        "disk, then run the same command again"
    )


@contextmanager
def _own_folder(path: Path) -> Iterator[Path]:
    while True:
        folder = Path(tempfile.mkdtemp(dir=path.parent, prefix=_prefix(path), suffix=_SUFFIX))
        try:
            handle = os.open(folder, os.O_RDONLY)
        except FileNotFoundError:  # another process took it for an abandoned one before it was opened
            continue
        with suppress(OSError):  # some network file systems lock no folder; there nothing is removed either
            fcntl.flock(handle, fcntl.LOCK_SH)
        if folder.exists():
            break
        os.close(handle)  # likewise, before it was locked
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(handle)


def _remove_abandoned(path: Path) -> None:
    for folder in path.parent.iterdir():
        if folder.name.startswith(_prefix(path)) and folder.name.endswith(_SUFFIX):
            with suppress(OSError):  # in use, gone meanwhile, or not ours to remove
                _remove_unlocked(folder)


def _remove_unlocked(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(handle)


def _prefix(path: Path) -> str:
    return f".{path.name}."
