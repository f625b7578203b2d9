"""The content of checkpoints and other files that settings name, by which a study knows its runs.

Times, owners and the path of a file change when it is copied or moved; its bytes do not. The hash of each file is
kept in the user's cache, with the file's identity on its file system: a plan does not read gigabytes twice.
"""

import hashlib
import json
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.drafts import write_whole
from probe_kit._system.user_cache import user_cache
from probe_kit._terminal.console import say
from probe_kit.errors import ProbeKitError
from probe_kit.hashing import sha256_json, sha256_text
from probe_kit.runs.run_folders import in_units

LONG_READ = 1 << 30
"""Bytes from which reading is announced: seconds on a fast disk, minutes on a slow one."""
_SETTLED_NS = 2_000_000_000
"""Age at which a file's times distinguish it from a later state; file systems count up to two seconds as one."""
_MOST_BYTES = 1 << 16


def content_of(path: str | Path) -> str | None:
    """Return the hash of the names and bytes of a file, or of all files below a folder, as 64 hex digits.

    Hidden files are left out: no loader reads them, and downloads and version control write times there.

    Args:
        path: The file or folder; `~` is the user's home.

    Returns:
        None where no file is, or where one cannot be read: an empty mount point is no checkpoint.
    """
    try:
        folder = Path(path).expanduser()
        files = list(_files(folder))
        cached = {file: _cached_hash(file) for file in files}
        unread = sum(file.stat().st_size for file in files if cached[file] is None)
        if unread >= LONG_READ:
            say(f"reading {in_units(unread)} of {path}, once: a run is known by the content of its checkpoint")
        hashes = {file: cached[file] or _read_hash(file) for file in files}
    except (OSError, RuntimeError):  # RuntimeError: ~name of an unknown user
        return None
    return sha256_json([[_name(file, folder), digest] for file, digest in hashes.items()]) if files else None


def former_stamp(path: str) -> list[list[str | int]] | None:
    """Return name, size and time of every file, by which earlier versions named runs; None where no file is."""
    folder = Path(path).expanduser()
    files = sorted(folder.rglob("*")) if folder.is_dir() else [folder]
    stats = [(file, file.stat()) for file in files if file.is_file()]
    return [[_name(file, folder), stat.st_size, stat.st_mtime_ns] for file, stat in stats] or None


def _name(file: Path, folder: Path) -> str:
    return file.relative_to(folder).as_posix()


def _files(path: Path) -> Iterator[Path]:
    """Yield a file, or the files below a folder that are not hidden, in order.

    Raises:
        OSError: For a folder that cannot be listed.
    """
    if path.is_file():
        yield path
        return

    def refuse(error: OSError) -> None:
        raise error

    for home, folders, names in os.walk(path, onerror=refuse):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        files = (Path(home) / name for name in sorted(names) if not name.startswith("."))
        yield from (file for file in files if file.is_file())


def _identity(file: Path) -> list[str | int]:
    """Return what changes whenever the bytes at a path do: the time of change too, which no program sets back."""
    stat = file.stat()
    times = (stat.st_mtime_ns, stat.st_ctime_ns)
    return [os.path.abspath(file), stat.st_dev, stat.st_ino, stat.st_size, *times]  # noqa: PTH100 - links stay


def _entry(identity: list[str | int]) -> Path:
    return user_cache() / "file-hashes" / f"{sha256_text(str(identity[0]))[:32]}.json"


def _cached_hash(file: Path) -> str | None:
    identity = _identity(file)
    try:
        entry = json.loads(read_regular(_entry(identity), _MOST_BYTES))
        digest = entry["sha256"] if entry["file"] == identity else None
    except (OSError, RuntimeError, ValueError, KeyError, TypeError):
        return None
    return digest if isinstance(digest, str) and len(digest) == 64 else None


def _read_hash(file: Path) -> str:
    """Return the sha256 of a file, and keep it if the file's times distinguish it from later states."""
    before, begun = _identity(file), time.time_ns()
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    newest = max(time for time in before[-2:] if isinstance(time, int))
    if before == _identity(file) and newest + _SETTLED_NS < begun:
        with suppress(OSError, RuntimeError, ProbeKitError):  # without a cache it is read again
            write_whole(_entry(before), json.dumps({"file": before, "sha256": digest}))
    return digest
