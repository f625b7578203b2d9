"""The plan of a run: its rows and their order, the records that store it, and its growth.

    plan/00000000.json    the first selection of a source: its rows, their order, and what was selected
    plan/<n>.json         the n-th growth: the rows it adds, and the order of all of them

A run grows by a further record; none is ever changed. Commits name the hash of the record that planned their
episode. An episode keeps its number for ever; `order` is that of the same selection planned at once. Of rows that
arrive one by one, as in a served run, a record holds the row alone: they follow those before it.
"""

import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count, islice
from typing import Any, ClassVar, NotRequired, Self, TypedDict, overload

from pydantic import ConfigDict

from probe_kit.errors import RunDamagedError, SettingsMismatchError
from probe_kit.runs.layout import PLANS, StoredStream
from probe_kit.runs.records import RESTORE, Record
from probe_kit.runs.store import Location

RowColumns = Mapping[str, Any]
"""A row as flat columns."""
_NUMBERED = re.compile(rf"{PLANS}/[0-9]{{8}}\.json")
_NUMBER, _CONTENT = "episode", "content_blake2b"
"""The part of a row that depends on when it was added, and of recordings the hash of the files that hold it."""


@dataclass(frozen=True)
class Row:
    """A row of a plan, whatever its source: an episode of a scene, a stretch of a recording, a picture.

    Attributes:
        index: Its number in the run, where its objects lie. In a run that grew, numbers are not in the plan's
            order.
        columns: The row as flat columns, of which every source has `episode_id`, `item_id`, `category`,
            `group_id`, `instruction` and `policy_seed`.
        content: The content that the source's player plays.
        frames: Recorded frames that the inferences see. None: every inference sees the result of the actions
            before it.
        noise: The numbers from which the seeds of the inferences derive; None for those of `frames`.
    """

    index: int
    columns: RowColumns
    content: Any = None
    frames: Sequence[int] | None = None
    noise: Sequence[int] | None = None

    @property
    def episode_id(self) -> str:
        """The row's id, the same in every selection."""
        return str(self.columns["episode_id"])

    @property
    def category(self) -> str:
        """The category by which tables group the row."""
        return str(self.columns["category"])

    @property
    def instruction(self) -> str:
        """The words that the model reads."""
        return str(self.columns["instruction"])

    @property
    def policy_seed(self) -> int:
        """The seed from which every inference of the row derives its own."""
        return int(self.columns["policy_seed"])

    def control_step(self, call: int, executed: int) -> int:
        """Return the step that inference `call` sees: a recorded frame, or the actions executed before it."""
        return executed if self.frames is None else self.frames[call]

    def noise_of(self, call: int) -> int:
        """Return the number from which the seed of inference `call` derives, whatever other frames were chosen."""
        numbers = self.frames if self.noise is None else self.noise
        return call if numbers is None else numbers[call]

    def to_json(self) -> dict[str, Any]:
        """Return the row as flat columns, with its number."""
        return {_NUMBER: self.index, **self.columns}


@dataclass(frozen=True)
class Plan:
    """All rows of a run in order, and how their streams are stored.

    Attributes:
        bytes: The bytes of their activations.
        identity: The part of a run's identity that says where observations come from.
        selection: The selected items as they stand among a run's settings; no part of its identity.
        name_parts: The values beside its identity on which the default name of a run depends.
        suite_parent: The content hash of the suite that a suite was selected from; None for a whole suite.
        decoder: The decoder of stored videos on this machine, with its version; None without videos.
    """

    episodes: tuple[Row, ...]
    streams: tuple[StoredStream, ...]
    bytes: int
    identity: Mapping[str, Any] = field(default_factory=dict)
    selection: dict[str, Any] = field(default_factory=dict)
    name_parts: Sequence[Any] = ()
    suite_parent: str | None = None
    decoder: str | None = None

    @property
    def columns(self) -> list[dict[str, Any]]:
        """The rows as flat columns."""
        return [row.to_json() for row in self.episodes]

    def numbered(self, numbers: Mapping[str, int]) -> Self:
        """Return the same rows, in the same order, with the numbers that a run has for their ids."""
        rows = tuple(replace(row, index=numbers[row.episode_id]) for row in self.episodes)
        return replace(self, episodes=rows)

    def only(self, episodes: Iterable[Row]) -> Self:
        """Return a plan of these rows alone, with their share of the bytes."""
        rows = tuple(episodes)
        return replace(self, episodes=rows, bytes=self.bytes * len(rows) // max(1, len(self.episodes)))

    def episode(self, number: int) -> Row:
        """Return the row that has this number. Raises KeyError."""
        return self._by_number[number]

    @cached_property
    def _by_number(self) -> dict[int, Row]:
        return {row.index: row for row in self.episodes}

    @property
    def sites(self) -> int:
        """The number of captured sites per inference."""
        return sum(len(stream.stream.sites()) for stream in self.streams)


# -- records -----------------------------------------------------------------------------------------------------


_STORED = ConfigDict(extra="allow", strict=True)


class _Suite(TypedDict):
    """The selected suite."""

    __pydantic_config__ = _STORED  # type: ignore[misc]  # pydantic's way to configure a TypedDict
    identity: str
    content_sha256: str
    seed_text: str


class _Wordings(TypedDict):
    """The wordings that were asked in."""

    __pydantic_config__ = _STORED  # type: ignore[misc]
    names: list[str]


class _Rows(TypedDict):
    """The chosen rows of recordings or of an environment."""

    __pydantic_config__ = _STORED  # type: ignore[misc]
    name: str
    episodes: list[Any]


class Selection(TypedDict):
    """The selected part of a suite, of recordings, or of an environment."""

    __pydantic_config__ = _STORED  # type: ignore[misc]
    suite: NotRequired[_Suite]
    categories: NotRequired[list[str]]
    items: NotRequired[int]
    wordings: NotRequired[_Wordings]
    recording: NotRequired[_Rows]
    played: NotRequired[_Rows]


class StoredRow(TypedDict):
    """A planned row: columns of every source, then those of a scene, of recordings, and of an environment."""

    __pydantic_config__ = _STORED  # type: ignore[misc]
    episode: int
    episode_id: str
    item_id: str
    category: str
    group_id: str
    instruction: NotRequired[str]
    layout: NotRequired[str]
    side_correct: NotRequired[str]
    item_content_sha256: NotRequired[str]
    source_episode: NotRequired[int]
    first_frame: NotRequired[int]
    frame_step: NotRequired[int]
    frames: NotRequired[int]
    content_blake2b: NotRequired[str]
    env_episode: NotRequired[int]
    env_seed: NotRequired[int]


class PlanRecord(Record):
    """The record of one selection, or of a row that arrived.

    Attributes:
        selection: What was selected; None for what the record before says.
        tokens: The sequence length T by stream, where pooled views alone are stored.
        order: The numbers of all episodes so far, in the plan's order; None where its own follow those before.
    """

    kind: ClassVar[str] = "plan"
    run: str
    record: int
    selection: Selection | None = None
    suite_parent: str | None = None
    tokens: dict[str, int]
    episodes: list[StoredRow]
    order: list[int] | None = None


class Prefix[T](Sequence[T]):
    """The first items of a list that grows at its end. A longer prefix shares the list, so that none is copied."""

    def __init__(self, items: list[T], count: int) -> None:
        self._items, self._count = items, count

    @classmethod
    def of(cls, items: Sequence[T]) -> "Prefix[T]":
        """Return all of `items`, which are copied unless they are a prefix."""
        return items if isinstance(items, Prefix) else cls(list(items), len(items))

    def extend(self, items: Iterable[T]) -> "Prefix[T]":
        """Return a prefix with further items; this one keeps its own."""
        shared = self._items if len(self._items) == self._count else self._items[: self._count]
        shared.extend(items)
        return Prefix(shared, len(shared))

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[T]:
        return islice(self._items, self._count)

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> list[T]: ...
    def __getitem__(self, index: int | slice) -> T | list[T]:
        if isinstance(index, slice):
            return [self._items[at] for at in range(*index.indices(self._count))]
        return self._items[range(self._count)[index]]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)

    __hash__ = None  # type: ignore[assignment]  # as of a list


@dataclass(frozen=True)
class StoredPlan:
    """All plan records of a run together.

    Attributes:
        rows: The episodes in order.
        selection: The selection of the newest record.
        suite_parent: The suite's parent in the newest record, see `Plan`.
        tokens: The sequence length T by stream in the newest record, see `PlanRecord`.
        extents: The number of planned episodes after each record.
        hashes: The hashes of the records, which the commits of their episodes name.
    """

    rows: Sequence[RowColumns] = ()
    selection: Mapping[str, Any] = field(default_factory=dict)
    suite_parent: str | None = None
    tokens: Mapping[str, int] = field(default_factory=dict)
    extents: Sequence[int] = ()
    hashes: Sequence[str] = ()

    def hash_of(self, number: int) -> str:
        """Return the hash of the record that added the episode of this number."""
        return self.hashes[bisect_right(self.extents, number)]

    def with_record(self, record: PlanRecord) -> "StoredPlan":
        """Return the plan after a further record, whose rows follow those before."""
        rows = Prefix.of(self.rows).extend(record.episodes)
        return StoredPlan(
            rows,
            self.selection if record.selection is None else record.selection,
            record.suite_parent,
            record.tokens,
            Prefix.of(self.extents).extend([len(rows)]),
            Prefix.of(self.hashes).extend([record.hash]),
        )


def plan_key(record: int) -> str:
    """Return the key of the plan record of this number; 0 is the first selection."""
    return f"{PLANS}/{record:08d}.json"


def count_plans(location: Location) -> int:
    """Return the number of plan records of a run. A run that begins right now may have none."""
    return next(record for record in count() if not location.exists(plan_key(record)))


def read_plans(location: Location, run: str, columns: Iterable[str]) -> StoredPlan:
    """Return all plan records together; without any rows for a run that has none yet.

    Args:
        location: The run.
        run: The identity of the run.
        columns: The columns that every row has.

    Raises:
        RunDamagedError: If a record is missing, was changed, or belongs elsewhere.
    """
    listed = location.keys(PLANS)  # first: a record that is written meanwhile is read, and never missed
    contents = location.read_all(PLANS, ".json")
    rows: list[RowColumns] = []
    by_number: dict[int, RowColumns] = {}
    ids: set[str] = set()
    records: list[PlanRecord] = []
    extents: list[int] = []
    for number in count():
        key = plan_key(number)
        raw = contents.get(key.removeprefix(f"{PLANS}/"))
        if raw is None:
            break
        name = f"{location}/{key}"
        record = PlanRecord.parse(raw, name, RESTORE, run=run, record=number)
        _check_rows(record, by_number, ids, columns, name)
        by_number |= {row["episode"]: row for row in record.episodes}
        if record.order is None:
            rows += record.episodes
        else:
            rows = [by_number[episode] for episode in record.order]
        records.append(record)
        extents.append(len(rows))
    missing = plan_key(len(records))
    if later := [key for key in listed if _NUMBERED.fullmatch(key) and key > missing]:
        raise RunDamagedError(f"{location}/{missing} is missing, though {later[0]} is there. {RESTORE}")
    if not records:
        return StoredPlan()
    selection = next((record.selection for record in reversed(records) if record.selection is not None), None)
    if selection is None:
        raise RunDamagedError(f"{location}/{plan_key(0)} lacks the selection. {RESTORE}")
    return StoredPlan(
        rows,
        selection,
        records[-1].suite_parent,
        records[-1].tokens,
        tuple(extents),
        tuple(record.hash for record in records),
    )


def _check_rows(
    record: PlanRecord, before: Mapping[int, RowColumns], ids: set[str], columns: Iterable[str], name: str
) -> None:
    """Raise RunDamagedError unless new rows have all columns, and numbers behind those `before` without a gap.

    The ids of the new rows are added to `ids`.
    """
    if lacking := [column for row in record.episodes for column in columns if column not in row]:
        raise RunDamagedError(f"{name} has an episode without {lacking[0]}. {RESTORE}")
    numbers = [row["episode"] for row in record.episodes]
    total = len(before) + len(numbers)
    ids |= {row["episode_id"] for row in record.episodes}
    ordered = record.order is None or sorted(record.order) == list(range(total))
    if numbers != list(range(len(before), total)) or not ordered or len(ids) != total:
        raise RunDamagedError(f"{name} numbers or orders its episodes in another way than plans do. {RESTORE}")


def while_growing[Result](location: Location, read: Callable[[], Result]) -> Result:
    """Return the result of `read`, which is called again if the run grew meanwhile; errors are those of `read`.

    The parts of two states do not fit together.
    """
    while True:
        before = count_plans(location)
        try:
            return read()
        except RunDamagedError:
            if count_plans(location) == before:
                raise


# -- growth ------------------------------------------------------------------------------------------------------


def further_rows(
    stored: Sequence[RowColumns], requested: Sequence[RowColumns], location: Location
) -> list[RowColumns]:
    """Return the rows of a plan that the stored one lacks; none if the stored one holds them all.

    Raises:
        SettingsMismatchError: If both plan one episode differently, or if each has some that the other lacks.
    """
    was, now = ({row["episode_id"]: row for row in rows} for rows in (stored, requested))
    for name in was.keys() & now.keys():
        _check_equal(was[name], now[name], location)
    added = [row for name, row in now.items() if name not in was]
    lost = [row for name, row in was.items() if name not in now]
    if added and lost:
        raise SettingsMismatchError(
            f"{location} has {_contents(stored)}; this command asks for {_contents(requested)}. A run grows and "
            f"never gets smaller, and {len(lost)} of its episodes are not asked for (the first is "
            f"{lost[0]['episode_id']}). Ask for at least what it has, or choose another --out"
        )
    return added


def _check_equal(was: RowColumns, now: RowColumns, location: Location) -> None:
    """Raise SettingsMismatchError unless an episode is planned as it is stored, but for its number."""
    # Every part, not the id alone: an item that was edited keeps its id, and has another content.
    for part in sorted((was.keys() | now.keys()) - {_NUMBER}):
        if was.get(part) != now.get(part):
            if part == _CONTENT:
                raise SettingsMismatchError(
                    f"the files that {was['episode_id']} shows have changed since {location} "
                    f"began: their {part} is stored as {was.get(part)!r}, here {now.get(part)!r}. Give them "
                    "as they were, or choose another --out"
                )
            raise SettingsMismatchError(
                f"{location} plans {was['episode_id']} otherwise: its {part} is stored as {was.get(part)!r}, here "
                f"{now.get(part)!r}. Use the suite, the kind of --wordings and the version of probe_kit that the "
                "run began with, or choose another --out"
            )


def _contents(rows: Sequence[RowColumns]) -> str:
    """Return the number of items by category in words, and the wordings they are asked in."""
    items = {row["item_id"]: row["category"] for row in rows}
    counts = ", ".join(f"{name} {count}" for name, count in sorted(Counter(items.values()).items()))
    wordings = ", ".join(dict.fromkeys(row["wording"] for row in rows if "wording" in row))
    return f"items of {counts}" + (f" in the wordings {wordings}" if wordings else "")
