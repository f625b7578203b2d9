"""Commits: the small record that makes an episode count, written last and exactly once."""

import json
from collections.abc import Mapping
from typing import Any

import google_crc32c
from zarr.abc.store import Store
from zarr.core.buffer import Buffer
from zarr.storage import WrapperStore

from probe_kit.errors import RunDamagedError
from probe_kit.extract.store.layout import COMMITS, DATA, FAILED
from probe_kit.extract.store.location import Location
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


def as_json(content: Mapping[str, Any]) -> bytes:
    """The one way JSON is written in a run: keys sorted, a line each."""
    return json.dumps(content, sort_keys=True, indent=1, allow_nan=False).encode()


def create_once(location: Location, key: str, content: Mapping[str, Any]) -> bool:
    """Write JSON under `key` unless it exists; True if this call wrote it. Exclusive and atomic."""
    return location.create(key, as_json(content))


def write_commit(location: Location, number: int, commit: Commit) -> bool:
    """Make episode `number` count; False if another writer was first."""
    return create_once(location, commit_key(number), {**commit, CHECKSUM: commit_checksum(commit)})


def commit_key(number: int) -> str:
    """Where the commit of episode `number` lies."""
    return f"{COMMITS}/{number:08d}.json"


def commit_checksum(commit: Commit) -> str:
    """crc32c over everything else a commit says."""
    return crc32c(canonical_json({key: value for key, value in commit.items() if key != CHECKSUM}).encode())


def read_commits(location: Location) -> dict[int, Commit]:
    """All commits by episode number, each checked against the sizes of the objects it names.

    Raises RunDamagedError naming the first object that is missing or has another size.
    """
    commits: dict[int, Commit] = {
        int(name.removesuffix(".json")): json.loads(text)
        for name, text in location.read_all(COMMITS, ".json").items()
    }
    sizes = committed_sizes(location, commits)
    for number, commit in commits.items():
        for key, (length, _) in commit["objects"].items():
            problem = wrong_size(sizes, key, length)
            if problem:
                raise RunDamagedError(
                    f"{location}/{DATA}/{key} of episode {commit['episode_id']} {problem}. Delete "
                    f"{commit_key(number)} and run the same `probe-kit extract` again to redo the episode"
                )
    return commits


def committed_sizes(location: Location, commits: Mapping[int, Commit]) -> dict[str, int]:
    """Bytes of every object that a commit names, as far as it is there."""
    return location.sizes(DATA, (key for commit in commits.values() for key in commit["objects"]))


def stamp_of(commits: Mapping[int, Commit]) -> str:
    """Hash of all commits: what derived files say they were made from."""
    return sha256_json([[number, commits[number]] for number in sorted(commits)])


def wrong_size(sizes: Mapping[str, int], key: str, length: int) -> str | None:
    """What is wrong with the size of a committed object, or None."""
    if key not in sizes:
        return "is missing"
    return None if sizes[key] == length else f"has {sizes[key]} bytes; its commit says {length} bytes"


def write_failure(location: Location, number: int, episode_id: str, reason: str) -> None:
    """Record why an episode was given up."""
    create_once(location, f"{FAILED}/{number:08d}.json", {"episode_id": episode_id, "reason": reason})


def read_failures(location: Location) -> dict[str, str]:
    """Reason by episode id of every episode that was given up."""
    records = [json.loads(text) for text in location.read_all(FAILED, ".json").values()]
    return {record["episode_id"]: record["reason"] for record in records}
