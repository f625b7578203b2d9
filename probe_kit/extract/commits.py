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
from probe_kit.extract.layout import COMMITS, DATA, FAILED
from probe_kit.identity import canonical_json, sha256_json

Commit = dict[str, Any]
CHECKSUM = "crc32c"


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
        self.objects[key] = (len(content), crc32c(content))


def crc32c(content: bytes) -> str:
    """The checksum commits carry, as eight hex digits."""
    return f"{google_crc32c.value(content):08x}"


def create_once(path: Path, content: Mapping[str, Any]) -> bool:
    """Write canonical JSON under `path` unless it exists; True if this call wrote it.

    Exclusive and atomic: written aside, flushed to the disk, then linked to its name.
    """
    handle, aside = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "w") as file:
            json.dump(content, file, sort_keys=True, indent=1, allow_nan=False)
            file.flush()
            os.fsync(file.fileno())
        os.link(aside, path)
    except FileExistsError:
        return False
    finally:
        Path(aside).unlink()
    return True


def write_commit(run: Path, number: int, commit: Commit) -> bool:
    """Make episode `number` count; False if another writer was first."""
    return create_once(commit_path(run, number), {**commit, CHECKSUM: commit_checksum(commit)})


def commit_path(run: Path, number: int) -> Path:
    """Where the commit of episode `number` lies."""
    return run / COMMITS / f"{number:08d}.json"


def commit_checksum(commit: Commit) -> str:
    """crc32c over everything else a commit says."""
    return crc32c(canonical_json({key: value for key, value in commit.items() if key != CHECKSUM}).encode())


def read_commits(run: Path) -> dict[int, Commit]:
    """All commits by episode number, each checked against the sizes of the objects it names.

    Raises RunDamagedError naming the first object that is missing or has another size.
    """
    commits = {}
    for path in sorted((run / COMMITS).glob("*.json")):
        commit = json.loads(path.read_text())
        for key, (length, _) in commit["objects"].items():
            problem = wrong_size(run, key, length)
            if problem:
                raise RunDamagedError(
                    f"{run / DATA / key} of episode {commit['episode_id']} {problem}. Delete "
                    f"{COMMITS}/{path.name} and run the same `probe-kit extract` again to redo the episode"
                )
        commits[int(path.stem)] = commit
    return commits


def stamp_of(commits: Mapping[int, Commit]) -> str:
    """Hash of all commits: what derived files say they were made from."""
    return sha256_json([[number, commits[number]] for number in sorted(commits)])


def wrong_size(run: Path, key: str, length: int) -> str | None:
    """What is wrong with the size of a committed object, or None."""
    path = run / DATA / key
    if not path.is_file():
        return "is missing"
    found = path.stat().st_size
    return None if found == length else f"has {found} bytes; its commit says {length} bytes"


def write_failure(run: Path, number: int, episode_id: str, reason: str) -> None:
    """Record why an episode was given up."""
    (run / FAILED).mkdir(exist_ok=True)
    create_once(run / FAILED / f"{number:08d}.json", {"episode_id": episode_id, "reason": reason})


def read_failures(run: Path) -> dict[str, str]:
    """Reason by episode id of every episode that was given up."""
    records = [json.loads(path.read_text()) for path in sorted((run / FAILED).glob("*.json"))]
    return {record["episode_id"]: record["reason"] for record in records}
