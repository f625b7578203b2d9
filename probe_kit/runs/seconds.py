"""Seconds of an episode: how long its inferences and its simulation took.

    times/<n>.json    a record per committed episode, written before its commit, which does not name it

Two runs of one identity take different times, so no other record holds the hash of these. No number of a table
comes from them, and the whole folder may be deleted. A record that is missing beside others is damage.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from math import isfinite

from probe_kit.errors import RunDamagedError
from probe_kit.runs.commits import Commit, numbered
from probe_kit.runs.layout import TIMES
from probe_kit.runs.records import as_record, expect, read_record
from probe_kit.runs.root import Root


@dataclass(frozen=True)
class Seconds:
    """Wall-clock seconds that one episode took.

    inference: of the model's calls; of a call for several observations, its share. simulation: of setting up,
    simulating and drawing.
    """

    inference: float = 0.0
    simulation: float = 0.0


NOT_MEASURED = Seconds(float("nan"), float("nan"))


def seconds_key(number: int) -> str:
    """Where the seconds of episode `number` lie."""
    return f"{TIMES}/{number:08d}.json"


def write_seconds(root: Root, number: int, seconds: Seconds) -> None:
    """Store them; those of an earlier try of the episode are replaced."""
    rounded = {name: round(value, 6) for name, value in asdict(seconds).items()}
    root.location.write(seconds_key(number), as_record({"run": root.identity, "episode": number, **rounded}))


def read_seconds(root: Root, commits: Mapping[int, Commit]) -> dict[int, Seconds]:
    """By episode number, NaN for all where none are stored. Raises RunDamagedError for the first that is wrong."""
    found: dict[int, Seconds] = {}
    for number, seconds in _stored(root, commits):
        if isinstance(seconds, str):
            raise RunDamagedError(seconds)
        found[number] = seconds
    if problem := next(_missing(root, commits, found), None):
        raise RunDamagedError(problem)
    return {number: found.get(number, NOT_MEASURED) for number in commits}


def seconds_problems(root: Root, commits: Mapping[int, Commit]) -> Iterator[str]:
    """What is wrong with them, a sentence each."""
    found = dict(_stored(root, commits))
    yield from (one for one in found.values() if isinstance(one, str))
    yield from _missing(root, commits, found)


def _stored(root: Root, commits: Mapping[int, Commit]) -> Iterator[tuple[int, Seconds | str]]:
    """Seconds by episode number, or what is wrong with them."""
    for number, key, raw in _raw(root, commits):
        try:
            yield number, _read(root, number, key, raw)
        except RunDamagedError as error:
            yield number, str(error)


def _raw(root: Root, commits: Mapping[int, Commit]) -> Iterator[tuple[int, str, bytes]]:
    """Number, key and content of every record; a listing that lags behind is completed by asking for the key."""
    listed = list(numbered(root.location, TIMES))
    yield from listed
    for number in commits.keys() - {number for number, _, _ in listed} if listed else ():
        try:
            yield number, seconds_key(number), root.location.read(seconds_key(number))
        except FileNotFoundError:
            continue


def _missing(root: Root, commits: Mapping[int, Commit], found: Mapping[int, object]) -> Iterator[str]:
    for number in sorted(commits):
        if found and number not in found:
            yield f"{root.location}/{seconds_key(number)} is missing. {_ADVICE}"


def _read(root: Root, number: int, key: str, raw: bytes) -> Seconds:
    name = f"{root.location}/{key}"
    record = read_record(raw, name, _ADVICE)
    expect(record, {"run": str, "episode": int, "inference": float, "simulation": float}, name, _ADVICE)
    if (record["run"], record["episode"]) != (root.identity, number):
        raise RunDamagedError(f"{name} belongs to another run or episode. {_ADVICE}")
    seconds = Seconds(record["inference"], record["simulation"])
    if not all(isfinite(value) and value >= 0 for value in (seconds.inference, seconds.simulation)):
        raise RunDamagedError(f"{name} says {seconds}; expected seconds of at least 0. {_ADVICE}")
    return seconds


_ADVICE = f"Restore it from a copy, or delete the whole folder {TIMES}: no other number comes from it"
