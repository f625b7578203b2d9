"""Seconds of an episode: how long its inferences and its simulation took.

    times/<n>.json    a record per committed episode, written before its commit, which does not name it

Two runs of one identity take different times, so no other record holds the hash of these. No number of a table
comes from them, and the folder may be deleted as a unit. A record that is missing among others is damage.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import Field

from probe_kit.errors import RunDamagedError
from probe_kit.runs.commits import Commit, numbered
from probe_kit.runs.layout import TIMES
from probe_kit.runs.records import Record
from probe_kit.runs.root import Root

_ADVICE = f"Restore it from a copy, or delete the folder {TIMES}: no other number comes from it"
_Count = Annotated[float, Field(ge=0, allow_inf_nan=False)]


@dataclass(frozen=True)
class Seconds:
    """Wall-clock seconds that one episode took.

    inference: of the model's calls; of a call for several observations, its share. simulation: of setting up,
    simulating and drawing.
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
    """The key of the seconds of episode `number`."""
    return f"{TIMES}/{number:08d}.json"


def write_seconds(root: Root, number: int, seconds: Seconds) -> None:
    """Store them; those of an earlier try of the episode are replaced."""
    record = SecondsRecord(
        run=root.identity,
        episode=number,
        inference=round(seconds.inference, 6),  # to microseconds
        simulation=round(seconds.simulation, 6),
    )
    root.location.write(seconds_key(number), record.to_bytes())


def read_seconds(root: Root, commits: Mapping[int, Commit]) -> dict[int, Seconds]:
    """Read the seconds by episode number, NaN where none are stored. Raises RunDamagedError for a wrong one."""
    records = {number: _parse(root, number, key, raw) for number, key, raw in numbered(root.location, TIMES)}
    if problem := next(_missing(root, commits, records), None):
        raise RunDamagedError(problem)
    stored = {number: Seconds(record.inference, record.simulation) for number, record in records.items()}
    return {number: stored.get(number, NOT_MEASURED) for number in commits}


def seconds_problems(root: Root, commits: Mapping[int, Commit]) -> Iterator[str]:
    """Records that were changed or are missing, a sentence each."""
    stored = set()
    for number, key, raw in numbered(root.location, TIMES):
        stored.add(number)
        try:
            _parse(root, number, key, raw)
        except RunDamagedError as error:
            yield str(error)
    yield from _missing(root, commits, stored)


def _missing(root: Root, commits: Mapping[int, Commit], stored: Collection[int]) -> Iterator[str]:
    """A sentence per episode without seconds, unless no episode has any."""
    for number in sorted(commits) if stored else ():
        if number not in stored:
            yield f"{root.location}/{seconds_key(number)} is missing. {_ADVICE}"


def _parse(root: Root, number: int, key: str, raw: bytes) -> SecondsRecord:
    return SecondsRecord.parse(raw, f"{root.location}/{key}", _ADVICE, run=root.identity, episode=number)
