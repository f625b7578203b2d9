"""Commits: the record that makes an episode count, written last and exactly once; failures, and seconds.

    commits/<n>.json    what an episode is, and the hashes of its objects
    failed/<n>.json     why an episode was given up
    times/<n>.json      how long an episode took, written before its commit, which does not name it

Two runs of one identity take different times, so no other record holds the hash of these. No number of a table
comes from them, and the folder may be deleted as a unit. A record that is missing among others is damage.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, ClassVar

from pydantic import Field

from probe_kit.errors import RunDamagedError
from probe_kit.hashing import sha256_json
from probe_kit.runs.layout import COMMITS, DATA, FAILED, ILLUSTRATIONS, PLANS, TIMES, TRAJECTORY, TRAJECTORY_AXES
from probe_kit.runs.records import Record, Sums
from probe_kit.runs.root import Root, is_left_out
from probe_kit.runs.store import Location

_NUMBERED = re.compile(r"([0-9]{8})\.json")
Span = Annotated[tuple[str, int, int], Field(strict=False)]
"""The role, the first token, and the token behind the last one."""


class Commit(Record):
    """One finished episode.

    Attributes:
        run: The identity of the run.
        episode: The number of the episode in the run.
        plan: The hash of the record that planned the episode.
        outcome: The columns of `Run.episodes`.
        roles: Spans of tokens per captured inference and stream.
        control_steps: The control step of every inference.
        provenance: The name of the record in `provenance/`.
        objects: The sums of the episode's objects, by key in `data.zarr`.
        pictures: The sums of the episode's pictures, by key in the run.
        lens_margins: The logit lens of an answer by letter, left minus right per layer.
        frames: The number of frames in its picture, where it holds all of the episode.
    """

    kind: ClassVar[str] = "commit"
    run: str
    episode: int
    episode_id: str
    plan: str
    outcome: dict[str, Any]
    roles: list[dict[str, list[Span]]]
    control_steps: list[int]
    provenance: Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
    objects: Sums
    pictures: Sums
    instruction_ids: list[int] | None = None
    lens_margins: list[float] | None = None
    frames: Annotated[int, Field(ge=1)] | None = None


class Failure(Record):
    """The reason and traceback of an episode that was given up; removed when it is tried again."""

    kind: ClassVar[str] = "failure"
    run: str
    episode: int
    episode_id: str
    reason: str
    traceback: str


def write_commit(location: Location, commit: Commit) -> bool:
    """Make an episode count; return False if another writer was first."""
    return location.create(commit_key(commit.episode), commit.to_bytes())


def commit_key(number: int) -> str:
    """Return the key of the commit of episode `number`."""
    return f"{COMMITS}/{number:08d}.json"


def numbered_objects(location: Location, folder: str) -> Iterator[tuple[int, str, bytes]]:
    """Yield number, key and content of the objects `<eight digits>.json` in `folder`.

    Other names are ignored, such as those that file managers give to copies.
    """
    for name, raw in location.read_all(folder, ".json").items():
        if match := _NUMBERED.fullmatch(name):
            yield int(match[1]), f"{folder}/{name}", raw


def read_commits(root: Root, checked: Mapping[int, Commit] | None = None) -> dict[int, Commit]:
    """Return all commits by episode number, each checked, also against the sizes of the objects it names.

    Args:
        root: The root of the run.
        checked: Commits that were read and checked before; these are not read again.

    Raises:
        RunDamagedError: For the first commit that was changed or belongs elsewhere, or the first object that is
            missing or has another size. The message names it.
    """
    unread = _unread(root.location, checked) if checked else numbered_objects(root.location, COMMITS)
    commits = {number: read_commit(root, number, key, raw) for number, key, raw in unread}
    if problem := next(size_problems(root, commits), None):
        raise RunDamagedError(f"{root.location}/{problem}")
    return dict(sorted({**(checked or {}), **commits}.items()))


def _unread(location: Location, checked: Mapping[int, Commit]) -> Iterator[tuple[int, str, bytes]]:
    """Yield number, key and content of the commits that are not among the `checked` ones."""
    for key in location.keys(COMMITS):
        name = _NUMBERED.fullmatch(key.rpartition("/")[2])
        if name and int(name[1]) not in checked:
            yield int(name[1]), key, location.read(key)


def read_commit(root: Root, number: int, key: str, raw: bytes) -> Commit:
    """Return one commit. Raises RunDamagedError if it was changed, or belongs to another episode or run."""
    name = f"{root.location}/{key}"
    planned = root.planned.get(number)
    if planned is None:
        raise RunDamagedError(
            f"{name} commits an episode that the run does not plan; it has {len(root.plan)}. Restore the file in "
            f"{PLANS} that plans it, or repeat the `probe-kit extract` that let the run grow; a commit of another "
            "run is to be removed"
        )
    commit = Commit.parse(
        raw, name, redo(number), run=root.identity, episode=number, episode_id=planned["episode_id"],
        plan=root.stored_plan.hash_of(number),
    )  # fmt: skip
    if problem := next(_problems(root, commit), None):
        raise RunDamagedError(f"{name} {problem}. {redo(number)}")
    return commit


def _problems(root: Root, commit: Commit) -> Iterator[str]:
    """Yield the contents of a commit that no commit of this run can have."""
    if not isinstance(commit.outcome.get("outcome"), str):
        yield "says no outcome"
    # Fewer is no fault: an episode that ends early has fewer inferences than the run captures.
    enough = len(commit.roles) <= root.settings["captured_calls"]
    if not (enough and all(name in call for call in commit.roles for name in root.streams)):
        yield "says no roles of the tokens of every stream"
    if problem := _control_step_problem(commit):
        yield problem
    trajectory = object_key(TRAJECTORY, commit.episode, TRAJECTORY_AXES)
    needed = {object_key(name, commit.episode, axes) for name, axes in root.arrays.items()}
    if lost := needed - {*commit.objects}:
        yield f"names no object {min(lost)}"
    if strange_objects := {*commit.objects} - needed - {trajectory}:
        yield f"names {min(strange_objects)}, which is no object of this episode"
    if trajectory in commit.objects:
        if not root.has_trajectories:
            yield f"names {trajectory}, though the run keeps no trajectories"
        if type(commit.outcome.get("steps")) is not int:  # `isinstance` would take True for a number
            yield "does not say how many steps its trajectory has"
    if strange := [key for key in commit.pictures if not _is_picture(key)]:
        yield f"names {strange[0]!r} as a picture; pictures lie in {' or '.join(ILLUSTRATIONS)}"


def _control_step_problem(commit: Commit) -> str | None:
    """Return the fault in the control steps of the inferences: they rise, and none lies behind the end."""
    # They say at which action an inference was made: a wrong one would move it in time, silently.
    steps, ended = commit.control_steps, commit.outcome.get("steps")
    last = ended if type(ended) is int else None
    rising = all(before < after for before, after in pairwise(steps))
    if not rising or (steps and (steps[0] < 0 or (last is not None and steps[-1] >= max(last, 1)))):
        return f"has {str(steps)[:60]} as control steps of its inferences, in an episode of {ended} steps"
    if len(steps) < len(commit.roles):
        return f"has control steps of {len(steps)} inferences, and {len(commit.roles)} were captured"
    return None


def object_key(array: str, number: int, axes: int) -> str:
    """Return the key of episode `number` in `data.zarr`: a chunk holds all of one episode."""
    return f"{array}/c/{number}{'/0' * (axes - 1)}"


def _is_picture(key: str) -> bool:
    folder, _, name = key.partition("/")
    return folder in ILLUSTRATIONS and "/" not in name and name not in ("", ".", "..")


def redo(number: int) -> str:
    """Return the remedy for a damaged episode."""
    return f"Delete {commit_key(number)} and run the same `probe-kit extract` again to redo the episode"


def redo_picture(number: int) -> str:
    """Return the remedy for a damaged picture of an episode."""
    return f"No number comes from it; to have it again: {redo(number)[0].lower()}{redo(number)[1:]}"


def size_problems(root: Root, commits: Mapping[int, Commit]) -> Iterator[str]:
    """Yield the objects of episodes that are missing or have another size, without reading them."""
    sizes = root.location.sizes(DATA, (key for commit in commits.values() for key in commit.objects))
    for number, commit in commits.items():
        for key, expected in commit.objects.items():
            size = sizes.get(key)
            problem = expected.size_problem(size)
            # An object of another size is damage in a copy too; only a missing one can be left out on purpose.
            if problem and not (size is None and is_left_out(key, root.left_out)):
                yield f"{DATA}/{key} of episode {commit.episode_id} {problem}. {redo(number)}"


def stamp_of(commits: Mapping[int, Commit]) -> str:
    """Return the hash of all commits, by which derived files name their source."""
    return sha256_json([[number, commits[number].hash] for number in sorted(commits)])


# -- failures ----------------------------------------------------------------------------------------------------


def write_failure(root: Root, number: int, reason: str, traceback: str = "") -> None:
    """Record why an episode was given up.

    Args:
        root: The root of the run.
        number: The episode's number in the run.
        reason: The reason in words.
        traceback: The traceback of its error; empty if its process died.
    """
    failure = Failure(
        run=root.identity,
        episode=number,
        episode_id=root.planned[number]["episode_id"],
        reason=_printable(reason),
        traceback=_printable(traceback),
    )
    root.location.create(failure_key(number), failure.to_bytes())


def _printable(text: str) -> str:
    """Return the text without half characters, which names of files may hold."""
    return text.encode(errors="backslashreplace").decode()


def failure_key(number: int) -> str:
    """Return the key of the failure of episode `number`."""
    return f"{FAILED}/{number:08d}.json"


def read_failures(root: Root) -> dict[str, str]:
    """Return the reason by episode id of every episode that was given up. Raises RunDamagedError."""
    advice = "Remove it; the same `probe-kit extract` tries the episode again"
    reasons = {}
    for number, key, raw in numbered_objects(root.location, FAILED):
        planned = root.planned.get(number, {}).get("episode_id")
        expected = {"run": root.identity, "episode": number, "episode_id": planned}
        failure = Failure.parse(raw, f"{root.location}/{key}", advice, **expected)
        reasons[failure.episode_id] = failure.reason
    return reasons


# -- seconds -----------------------------------------------------------------------------------------------------


_ADVICE = f"Restore it from a copy, or delete the folder {TIMES}: no other number comes from it"
_Count = Annotated[float, Field(ge=0, allow_inf_nan=False)]


@dataclass(frozen=True)
class Seconds:
    """Wall-clock seconds that one episode took.

    Attributes:
        inference: The seconds of the model's calls; a call for several observations counts with its share.
        simulation: The seconds of setting up, simulating and drawing.
    """

    inference: float = 0.0
    simulation: float = 0.0


NOT_MEASURED = Seconds(float("nan"), float("nan"))


class SecondsRecord(Record):
    """The seconds of one episode, see `Seconds`."""

    kind: ClassVar[str] = "record of seconds"
    run: str
    episode: int
    inference: _Count
    simulation: _Count


def seconds_key(number: int) -> str:
    """Return the key of the seconds of episode `number`."""
    return f"{TIMES}/{number:08d}.json"


def write_seconds(root: Root, number: int, seconds: Seconds) -> None:
    """Store the seconds of an episode; those of an earlier try are replaced."""
    record = SecondsRecord(
        run=root.identity,
        episode=number,
        inference=round(seconds.inference, 6),  # to microseconds
        simulation=round(seconds.simulation, 6),
    )
    root.location.write(seconds_key(number), record.to_bytes())


def read_seconds(root: Root, commits: Mapping[int, Commit]) -> dict[int, Seconds]:
    """Read the seconds by episode number, NaN where none are stored at all.

    Raises:
        RunDamagedError: For a record that was changed, or is missing among others.
    """
    stored = {}
    for number, key, raw in numbered_objects(root.location, TIMES):
        record = SecondsRecord.parse(raw, f"{root.location}/{key}", _ADVICE, run=root.identity, episode=number)
        stored[number] = Seconds(record.inference, record.simulation)
    if stored and (missing := sorted(commits.keys() - stored.keys())):
        raise RunDamagedError(f"{root.location}/{seconds_key(missing[0])} is missing. {_ADVICE}")
    return {number: stored.get(number, NOT_MEASURED) for number in commits}
