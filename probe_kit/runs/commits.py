"""Commits: the record that makes an episode count, written last and exactly once."""

import re
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

from probe_kit.errors import RunDamagedError
from probe_kit.hashing import sha256_json
from probe_kit.runs.layout import COMMITS, DATA, FAILED, ILLUSTRATIONS, PLANS, TRAJECTORY, TRAJECTORY_AXES
from probe_kit.runs.left_out import is_left_out
from probe_kit.runs.records import (
    HASH,
    Sum,
    as_record,
    check_sums,
    expect,
    read_record,
    read_sums,
)
from probe_kit.runs.root import Root
from probe_kit.runs.store import Location

Commit = dict[str, Any]
_PARTS = {
    "run": str,
    "episode": int,
    "episode_id": str,
    "outcome": dict,
    "roles": list,
    "control_steps": list,
    "provenance": str,
    "objects": dict,
}
FRAME_COUNT = "frames"
"""In a commit: how many frames its picture holds, where it holds all of the episode."""
LENS_MARGINS = "lens_margins"
"""In a commit: the logit lens of an answer by letter, left minus right, one number per layer."""
_NUMBERED = re.compile(r"([0-9]{8})\.json")
_PROVENANCE = re.compile(r"[0-9a-f]{16}")


def create_once(location: Location, key: str, content: Mapping[str, Any]) -> bool:
    """Write a record under `key` unless it exists; True if this call wrote it. Exclusive and atomic."""
    return location.create(key, as_record(content))


def write_commit(location: Location, number: int, commit: Commit) -> bool:
    """Make episode `number` count; False if another writer was first."""
    return create_once(location, commit_key(number), commit)


def commit_key(number: int) -> str:
    """Where the commit of episode `number` lies."""
    return f"{COMMITS}/{number:08d}.json"


def numbered(location: Location, folder: str) -> Iterator[tuple[int, str, bytes]]:
    """Number, key and content of the objects `<eight digits>.json` in `folder`.

    Other names are ignored, such as those that file managers give to copies.
    """
    for name, raw in location.read_all(folder, ".json").items():
        if found := _NUMBERED.fullmatch(name):
            yield int(found[1]), f"{folder}/{name}", raw


def read_commits(root: Root, known: Mapping[int, Commit] | None = None) -> dict[int, Commit]:
    """All commits by episode number, each checked, and against the sizes of the objects it names.

    known: commits that were read and checked before; these are not read again.
    Raises RunDamagedError naming the first commit that was changed or belongs elsewhere, or the first object that
    is missing or has another size.
    """
    location = root.location
    unread = _unread(location, known) if known else numbered(location, COMMITS)
    found = {number: read_commit(root, number, key, raw) for number, key, raw in unread}
    sizes = committed_sizes(location, found)
    for number, commit in found.items():
        for key, (length, *_) in commit["objects"].items():
            problem = wrong_size(sizes, key, length)
            if problem and not is_left_out(key, root.left_out):
                raise RunDamagedError(
                    f"{location}/{DATA}/{key} of episode {commit['episode_id']} {problem}. {redo(number)}"
                )
    commits = dict(sorted({**(known or {}), **found}.items()))
    root.check_room(commits)
    return commits


def _unread(location: Location, known: Mapping[int, Commit]) -> Iterator[tuple[int, str, bytes]]:
    """Number, key and content of the commits that are not among the `known` ones."""
    for key in location.keys(COMMITS):
        name = _NUMBERED.fullmatch(key.rpartition("/")[2])
        if name and int(name[1]) not in known:
            yield int(name[1]), key, location.read(key)


def read_commit(root: Root, number: int, key: str, raw: bytes) -> Commit:
    """One commit. Raises RunDamagedError if it was changed, or belongs to another episode or run."""
    name = f"{root.location}/{key}"
    commit = read_record(raw, name, redo(number))
    expect(commit, _PARTS, name, redo(number))
    planned = root.planned.get(number)
    if planned is None:
        raise RunDamagedError(
            f"{name} commits an episode that the run does not plan; it has {len(root.plan)}. Restore the file in "
            f"{PLANS} that plans it, or repeat the `probe-kit extract` that let the run grow; a commit of another "
            "run is to be removed"
        )
    plan = root.stored_plan.hash_of(number)
    expected = {"run": root.identity, "episode": number, "episode_id": planned["episode_id"], "plan": plan}
    if wrong := [f"{part} {commit.get(part)}" for part, value in expected.items() if commit.get(part) != value]:
        raise RunDamagedError(
            f"{name} is the commit of {', '.join(wrong)}; in this place belongs that of episode {number}, "
            f"{planned['episode_id']}, of run {root.identity}. {redo(number)}"
        )
    if problem := next(_problems(root, number, commit), None):
        raise RunDamagedError(f"{name} {problem}. {redo(number)}")
    check_sums(commit["objects"], name, redo(number))
    _check_pictures(commit, name, redo(number))
    return commit


def _problems(root: Root, number: int, commit: Commit) -> Iterator[str]:
    """What a commit says that none of this run can say."""
    if not _PROVENANCE.fullmatch(commit["provenance"]):
        yield f"names {commit['provenance']!r} as its provenance"
    if not isinstance(commit["outcome"].get("outcome"), str):
        yield "says no outcome"
    if not _are_roles(root, commit["roles"]):
        yield "says no roles of the tokens of every stream"
    ids = commit.get("instruction_ids", [])
    if not (isinstance(ids, list) and all(type(one) is int for one in ids)):
        yield "has other instruction ids than numbers"
    margins = commit.get(LENS_MARGINS, [])
    if not (isinstance(margins, list) and all(type(one) is float for one in margins)):
        yield "has other margins of the logit lens than numbers"
    if problem := _control_step_problem(commit):
        yield problem
    count = commit.get(FRAME_COUNT, 1)
    if type(count) is not int or count < 1:
        yield f"says {count!r} as the number of its frames"
    needed = {object_key(array, number, axes) for array, axes in root.arrays.items()}
    trajectory = object_key(TRAJECTORY, number, TRAJECTORY_AXES)
    if lost := sorted(needed - {*commit["objects"]}):
        yield f"names no hash of {DATA}/{lost[0]}, which every episode has"
    if strange := sorted({*commit["objects"]} - needed - {trajectory}):
        yield f"names {strange[0]!r}, which is no object of this episode"
    if trajectory in commit["objects"]:
        if f"{TRAJECTORY}/zarr.json" not in root.metadata:
            yield f"names {trajectory}, though the run keeps no trajectories"
        if type(commit["outcome"].get("steps")) is not int:
            yield "does not say how many steps its trajectory has"


def _control_step_problem(commit: Commit) -> str | None:
    """What is wrong with the control steps of the inferences: none before the last one, none behind the end."""
    steps = commit["control_steps"]
    if not all(type(step) is int for step in steps):
        return "has other control steps than numbers"
    ended = commit["outcome"].get("steps")
    last = ended if type(ended) is int else None
    rising = all(before < after for before, after in pairwise(steps))
    if not rising or (steps and (steps[0] < 0 or (last is not None and steps[-1] >= max(last, 1)))):
        return f"has {str(steps)[:60]} as control steps of its inferences, in an episode of {ended} steps"
    if len(steps) < len(commit["roles"]):
        return f"has control steps of {len(steps)} inferences, and {len(commit['roles'])} were captured"
    return None


def object_key(array: str, number: int, axes: int) -> str:
    """Where the object of episode `number` lies in `data.zarr`: a chunk holds all of one episode."""
    return f"{array}/c/{number}{'/0' * (axes - 1)}"


def _is_picture(key: str) -> bool:
    folder, _, name = key.partition("/")
    return folder in ILLUSTRATIONS and "/" not in name and name not in ("", ".", "..")


def _are_roles(root: Root, calls: list[Any]) -> bool:
    """Whether every captured inference says spans [role, start, stop] of the tokens of every stream."""
    return len(calls) <= root.settings["captured_calls"] and all(
        isinstance(call, dict) and all(_are_spans(call.get(name)) for name in root.streams) for call in calls
    )


def _are_spans(spans: Any) -> bool:
    return isinstance(spans, list) and all(
        isinstance(span, list) and [type(part) for part in span] == [str, int, int] for span in spans
    )


def redo(number: int) -> str:
    """What to do about a damaged episode."""
    return f"Delete {commit_key(number)} and run the same `probe-kit extract` again to redo the episode"


def redo_picture(number: int) -> str:
    """What to do about a damaged picture of an episode."""
    return f"No number comes from it; to have it again: {redo(number)[0].lower()}{redo(number)[1:]}"


def pictures_of(commit: Commit) -> dict[str, Sum]:
    """The sums of the pictures of an episode, by key in the run."""
    return read_sums(commit["pictures"])


def read_own_commit(location: Location, number: int) -> Commit | None:
    """The commit of one episode as it is stored, pictures checked; None without any. Raises RunDamagedError."""
    key = commit_key(number)
    name = f"{location}/{key}"
    try:
        commit = read_record(location.read(key), name, redo(number))
    except FileNotFoundError:
        return None
    _check_pictures(commit, name, redo(number))
    return commit


def _check_pictures(commit: Commit, name: str, advice: str) -> None:
    pictures = commit.get("pictures")
    if not isinstance(pictures, dict):
        raise RunDamagedError(f"{name} names no pictures by key. {advice}")
    if strange := [key for key in pictures if not _is_picture(key)]:
        raise RunDamagedError(
            f"{name} names {strange[0]!r} as a picture; pictures lie in {' or '.join(ILLUSTRATIONS)}. {advice}"
        )
    check_sums(pictures, name, advice)


def picture_problems(location: Location, commits: Mapping[int, Commit]) -> Iterator[str]:
    """Pictures that are missing or have another size. A user may delete the whole folder of pictures."""
    there = {
        f"{folder}/{name}": size
        for folder in ILLUSTRATIONS
        for name, size in location.sizes(folder, _names(location, folder)).items()
    }
    kept = {key.partition("/")[0] for key in there}
    for number, commit in commits.items():
        for key, known in pictures_of(commit).items():
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
    sums = {key: Sum.of(content) for key, content in root.metadata.items()}
    for commit in commits.values():
        sums |= read_sums(commit["objects"])
    return sums


def stamp_of(commits: Mapping[int, Commit]) -> str:
    """Hash of all commits: what derived files say they were made from."""
    return sha256_json([[number, commits[number][HASH]] for number in sorted(commits)])


def wrong_size(sizes: Mapping[str, int], key: str, length: int) -> str | None:
    """What is wrong with the size of a committed object, or None."""
    if key not in sizes:
        return "is missing"
    return None if sizes[key] == length else f"has {sizes[key]} bytes; its commit says {length} bytes"


def write_failure(root: Root, number: int, reason: str, traceback: str = "") -> None:
    """Record why an episode was given up. traceback: of its error, empty if its process died."""
    failure = {"run": root.identity, "episode": number, "episode_id": root.planned[number]["episode_id"]}
    for name, text in (
        ("reason", reason),
        ("traceback", traceback),
    ):  # names of files may hold what is no character
        failure[name] = text.encode(errors="backslashreplace").decode()
    create_once(root.location, failure_key(number), failure)


def failure_key(number: int) -> str:
    """Where the failure of episode `number` is stored in its run."""
    return f"{FAILED}/{number:08d}.json"


def read_failures(root: Root) -> dict[str, str]:
    """Reason by episode id of every episode that was given up. Raises RunDamagedError."""
    advice = "Remove it; the same `probe-kit extract` tries the episode again"
    reasons = {}
    for number, key, raw in numbered(root.location, FAILED):
        name = f"{root.location}/{key}"
        failure = read_record(raw, name, advice)
        expect(failure, {"run": str, "episode": int, "episode_id": str, "reason": str}, name, advice)
        planned = root.planned.get(number, {}).get("episode_id")
        if (failure["run"], failure["episode"], failure["episode_id"]) != (root.identity, number, planned):
            raise RunDamagedError(f"{name} belongs to another run or episode. {advice}")
        reasons[failure["episode_id"]] = failure["reason"]
    return reasons
