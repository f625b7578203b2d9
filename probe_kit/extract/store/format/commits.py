"""Commits: the small record that makes an episode count, written last and exactly once."""

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import google_crc32c

from probe_kit.errors import RunDamagedError
from probe_kit.extract.run_layout import COMMITS, DATA, FAILED, ILLUSTRATIONS
from probe_kit.extract.store.format.hashes import (
    HASH,
    Sum,
    as_record,
    expect,
    is_record,
    read_plain,
    read_record,
    read_sums,
)
from probe_kit.extract.store.format.root import Root
from probe_kit.extract.store.locations.location import Location
from probe_kit.hashing import canonical_json, sha256_json

Commit = dict[str, Any]
CHECKSUM = "crc32c"
"""What commits of former versions carry instead of a hash."""
_PARTS = {"episode_id": str, "outcome": dict, "roles": list, "objects": dict}
_NUMBERED = re.compile(r"(\d{8})\.json")


def crc32c(content: bytes) -> str:
    """The checksum that commits of former versions carry, as eight hex digits."""
    return f"{google_crc32c.value(content):08x}"


def crc32c_of(pieces: Iterable[bytes | memoryview]) -> tuple[int, str]:
    """Length and the same checksum of what these pieces are together."""
    value = length = 0
    for piece in pieces:
        value, length = google_crc32c.extend(value, bytes(piece)), length + len(piece)
    return length, f"{value:08x}"


def create_once(location: Location, key: str, content: Mapping[str, Any]) -> bool:
    """Write a record under `key` unless it exists; True if this call wrote it. Exclusive and atomic."""
    return location.create_record(key, as_record(content))


def write_commit(location: Location, number: int, commit: Commit) -> bool:
    """Make episode `number` count; False if another writer was first."""
    return create_once(location, commit_key(number), commit)


def commit_key(number: int) -> str:
    """Where the commit of episode `number` lies."""
    return f"{COMMITS}/{number:08d}.json"


def commit_checksum(commit: Commit) -> str:
    """crc32c over everything else that a commit of a former version says."""
    return crc32c(canonical_json({key: value for key, value in commit.items() if key != CHECKSUM}).encode())


def numbered(location: Location, folder: str) -> Iterator[tuple[int, str, bytes]]:
    """Number, key and content of the objects `<eight digits>.json` in `folder`.

    Other names are nobody's, such as those that file managers give to copies.
    """
    for name, raw in location.read_all(folder, ".json").items():
        if found := _NUMBERED.fullmatch(name):
            yield int(found[1]), f"{folder}/{name}", raw


def read_commits(root: Root) -> dict[int, Commit]:
    """All commits by episode number, each checked, and against the sizes of the objects it names.

    Raises RunDamagedError naming the first commit that was changed or belongs elsewhere, or the first object that
    is missing or has another size.
    """
    location = root.location
    commits = {number: read_commit(root, number, key, raw) for number, key, raw in numbered(location, COMMITS)}
    sizes = committed_sizes(location, commits)
    for number, commit in commits.items():
        for key, (length, *_) in commit["objects"].items():
            problem = wrong_size(sizes, key, length)
            if problem:
                raise RunDamagedError(
                    f"{location}/{DATA}/{key} of episode {commit['episode_id']} {problem}. {redo(number)}"
                )
    return commits


def read_commit(root: Root, number: int, key: str, raw: bytes) -> Commit:
    """One commit. Raises RunDamagedError if it was changed, or belongs to another episode or run."""
    name = f"{root.location}/{key}"
    if not root.protected:
        commit = read_plain(raw, name, redo(number))
        expect(commit, _PARTS, name, redo(number))
        return commit
    commit = read_record(raw, name, redo(number))
    expect(commit, _PARTS, name, redo(number))
    planned = root.planned.get(number)
    if planned is None:
        raise RunDamagedError(
            f"{name} commits an episode that the run does not plan; it has {len(root.plan)}. Remove it"
        )
    expected = {"run": root.identity, "episode": number, "episode_id": planned["episode_id"]}
    if wrong := [f"{part} {commit.get(part)}" for part, value in expected.items() if commit.get(part) != value]:
        raise RunDamagedError(
            f"{name} is the commit of {', '.join(wrong)}; in this place belongs that of episode {number}, "
            f"{planned['episode_id']}, of run {root.identity}. {redo(number)}"
        )
    return commit


def redo(number: int) -> str:
    """What to do about a damaged episode."""
    return f"Delete {commit_key(number)} and run the same `probe-kit extract` again to redo the episode"


def redo_picture(number: int) -> str:
    """What to do about a damaged picture of an episode."""
    return f"No number comes from it; to have it again: {redo(number)[0].lower()}{redo(number)[1:]}"


def pictures_of(commit: Commit) -> dict[str, Sum] | None:
    """Sums of the pictures of an episode by key in the run; None in commits that bind none, as former ones."""
    return read_sums(commit["pictures"]) if "pictures" in commit else None


def read_pictures(location: Location, number: int) -> dict[str, Sum] | None:
    """The same from the commit as it is stored; None also where there is no commit. Raises RunDamagedError."""
    try:
        raw = location.read(commit_key(number))
    except FileNotFoundError:
        return None
    return (
        pictures_of(read_record(raw, f"{location}/{commit_key(number)}", redo(number))) if is_record(raw) else None
    )


def picture_problems(location: Location, commits: Mapping[int, Commit]) -> Iterator[str]:
    """Pictures that are missing or have another size. Whoever wants none may delete a whole folder of them."""
    there = {
        f"{folder}/{name}": size
        for folder in ILLUSTRATIONS
        for name, size in location.sizes(folder, _names(location, folder)).items()
    }
    kept = {key.partition("/")[0] for key in there}
    for number, commit in commits.items():
        for key, known in (pictures_of(commit) or {}).items():
            if key not in there and key.partition("/")[0] in kept:
                yield f"{key} is missing. {redo_picture(number)}"
            elif key in there and there[key] != known.length:
                yield f"{key} has {there[key]} bytes; {known.length} were written. {redo_picture(number)}"


def _names(location: Location, folder: str) -> list[str]:
    return [key.removeprefix(f"{folder}/") for key in location.keys(folder)]


def committed_sizes(location: Location, commits: Mapping[int, Commit]) -> dict[str, int]:
    """Bytes of every object that a commit names, as far as it is there."""
    return location.sizes(DATA, (key for commit in commits.values() for key in commit["objects"]))


def committed_sums(root: Root, commits: Mapping[int, Commit]) -> dict[str, Sum]:
    """Sums of all that may be read in `data.zarr`, by key: metadata, and what commits name."""
    sums = dict(root.metadata)
    for commit in commits.values():
        sums |= read_sums(commit["objects"])
    return sums


def stamp_of(commits: Mapping[int, Commit]) -> str:
    """Hash of all commits: what derived files say they were made from."""
    return sha256_json([[number, commits[number].get(HASH, commits[number])] for number in sorted(commits)])


def wrong_size(sizes: Mapping[str, int], key: str, length: int) -> str | None:
    """What is wrong with the size of a committed object, or None."""
    if key not in sizes:
        return "is missing"
    return None if sizes[key] == length else f"has {sizes[key]} bytes; its commit says {length} bytes"


def write_failure(root: Root, number: int, reason: str) -> None:
    """Record why an episode was given up."""
    failure = {"run": root.identity, "episode": number, "episode_id": root.planned[number]["episode_id"]}
    create_once(root.location, f"{FAILED}/{number:08d}.json", {**failure, "reason": reason})


def read_failures(root: Root) -> dict[str, str]:
    """Reason by episode id of every episode that was given up. Raises RunDamagedError."""
    advice = "Remove it; the same `probe-kit extract` tries the episode again"
    reasons = {}
    for number, key, raw in numbered(root.location, FAILED):
        name = f"{root.location}/{key}"
        failure = read_record(raw, name, advice) if root.protected else read_plain(raw, name, advice)
        expect(failure, {"episode_id": str, "reason": str}, name, advice)
        if root.protected and (failure["run"], failure["episode"]) != (root.identity, number):
            raise RunDamagedError(f"{name} belongs to another run or episode. {advice}")
        reasons[failure["episode_id"]] = failure["reason"]
    return reasons
