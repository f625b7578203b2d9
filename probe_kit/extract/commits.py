"""Commits: the small record that makes an episode count, written last and exactly once."""

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import google_crc32c
from zarr.abc.store import Store
from zarr.core.buffer import Buffer
from zarr.storage import WrapperStore

from probe_kit.errors import RunDamagedError
from probe_kit.extract.layout import COMMITS, DATA


class RecordingStore(WrapperStore[Store]):
    """Passes writes on and remembers key, length and crc32c of every object."""

    def __init__(self, store: Store) -> None:
        super().__init__(store)
        self.objects: dict[str, tuple[int, str]] = {}

    async def set(self, key: str, value: Buffer) -> None:
        """Write one object."""
        self._record(key, value)
        await super().set(key, value)

    def set_sync(self, key: str, value: Buffer) -> None:
        """Write one object from synchronous code."""
        self._record(key, value)
        super().set_sync(key, value)

    def _record(self, key: str, value: Buffer) -> None:
        content = value.to_bytes()
        self.objects[key] = (len(content), f"{google_crc32c.value(content):08x}")


def create_once(path: Path, content: Mapping[str, Any]) -> bool:
    """Write canonical JSON under `path` unless it exists; True if this call wrote it.

    Exclusive and atomic: written aside, flushed to the disk, then linked to its name.
    """
    handle, aside = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    with os.fdopen(handle, "w") as file:
        json.dump(content, file, sort_keys=True, indent=1, allow_nan=False)
        file.flush()
        os.fsync(file.fileno())
    try:
        os.link(aside, path)
    except FileExistsError:
        return False
    finally:
        Path(aside).unlink()
    return True


def commit_path(run: Path, index: int) -> Path:
    """Where the commit of episode `index` lies."""
    return run / COMMITS / f"{index:08d}.json"


def read_commits(run: Path) -> dict[int, dict[str, Any]]:
    """All commits by episode index, each checked against the sizes of the objects it names.

    Raises RunDamagedError naming the first object that is missing or has another size.
    """
    commits = {}
    for path in sorted((run / COMMITS).glob("*.json")):
        commit = json.loads(path.read_text())
        for key, (length, _crc) in commit["objects"].items():
            _check_size(run / DATA / key, length, commit["episode_id"])
        commits[int(path.stem)] = commit
    return commits


def _check_size(path: Path, length: int, episode_id: str) -> None:
    found = path.stat().st_size if path.is_file() else None
    if found != length:
        seen = "is missing" if found is None else f"has {found} bytes"
        raise RunDamagedError(
            f"{path} of episode {episode_id} {seen}; its commit says {length} bytes. Delete that commit and run "
            "the same `probe-kit extract` again to redo the episode"
        )
