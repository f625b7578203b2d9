"""The root of a run: `run.json`, the plan of its episodes, and its label.

    run.json              settings, streams, hashes of all arrays' metadata, and its own: the run's identity
    plan/00000000.json    the first selection of a suite: its episodes, their order, their whole suite
    plan/<n>.json         the n-th growth: the episodes it adds, and the order of all of them
    label.json            the name of the run in tables, which may be changed at any time

Plans and commits name the identity, so that none counts in another run. `run.json` knows of no selection, so two
runs of other items have one identity. A run grows by a further plan record; none is ever changed. Commits name the
hash of the record that planned their episode. An episode keeps its number for ever; `order` is that of the same
selection planned at once.
"""

import re
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Annotated, Any, ClassVar, NoReturn

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator

from probe_kit.errors import ActivationsLeftOutError, RunDamagedError, RunNotFoundError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.hooks.contract.sites import Part
from probe_kit.runs.layout import (
    DATA,
    DATASET,
    ENVIRONMENT,
    INPUTS,
    LABEL_FILE,
    LEFT_OUT_FILE,
    MEAN_VIEW,
    PLANS,
    RUN_FILE,
    SCHEMA_VERSION,
    TRAJECTORY,
    LaterViews,
    StoredStream,
    VectorKind,
    stored_inputs_of,
)
from probe_kit.runs.records import RESTORE, Record, Sum, Sums, expect, read_plain
from probe_kit.runs.run_folders import what_to_open
from probe_kit.runs.store import Location, locate

Row = dict[str, Any]
_NUMBERED = re.compile(rf"{PLANS}/[0-9]{{8}}\.json")
_SELECTION = {"suite": dict, "categories": list, "items": int}


class PlanRecord(Record):
    """One selection. tokens: T by stream, where pooled views alone are stored. order: of all episodes so far."""

    kind: ClassVar[str] = "plan"
    run: str
    record: int
    selection: dict[str, Any]
    suite_parent: str | None
    tokens: dict[str, int]
    episodes: list[Row]
    order: list[int]


@dataclass(frozen=True)
class StoredPlan:
    """All plan records of a run together.

    rows: the episodes in order. selection, suite_parent, tokens: of the newest record, see `PlanRecord`. extents:
    planned episodes after each record. hashes: of the records, which the commits of their episodes name.
    """

    rows: Sequence[Row] = ()
    selection: Mapping[str, Any] = field(default_factory=dict)
    suite_parent: str | None = None
    tokens: Mapping[str, int] = field(default_factory=dict)
    extents: tuple[int, ...] = ()
    hashes: tuple[str, ...] = ()

    def hash_of(self, number: int) -> str:
        """Hash of the record that added the episode of this number."""
        return self.hashes[bisect_right(self.extents, number)]


def plan_key(record: int) -> str:
    """The key of the plan record of this number; 0 is the first selection."""
    return f"{PLANS}/{record:08d}.json"


def count_plans(location: Location) -> int:
    """Return the number of plan records of a run. A run that begins right now may have none."""
    return next(record for record in count() if not location.exists(plan_key(record)))


def read_plans(location: Location, run: str, check_row: Callable[[Row, str], None]) -> StoredPlan:
    """All plan records together; without any rows for a run that has none yet.

    run: its identity. check_row: raises for a row that is none, given its file's name.
    Raises RunDamagedError if a record is missing, was changed, or belongs elsewhere.
    """
    plan, by_number = StoredPlan(), dict[int, Row]()
    for number in count():
        name = f"{location}/{plan_key(number)}"
        try:
            raw = location.read(plan_key(number))
        except FileNotFoundError:
            break
        record = PlanRecord.parse(raw, name, RESTORE, run=run, record=number)
        _check_selection(record.selection, name)
        for row in record.episodes:
            check_row(row, name)
            by_number[row["episode"]] = row
        _check_order(record, len(plan.rows), by_number, name)
        rows = [by_number[episode] for episode in record.order]
        plan = StoredPlan(
            rows, record.selection, record.suite_parent, record.tokens,
            (*plan.extents, len(rows)), (*plan.hashes, record.hash),
        )  # fmt: skip
    missing = plan_key(len(plan.extents))
    if later := [key for key in location.keys(PLANS) if _NUMBERED.fullmatch(key) and key > missing]:
        raise RunDamagedError(f"{location}/{missing} is missing, though {later[0]} is there. {RESTORE}")
    return plan


def _check_selection(selection: Mapping[str, Any], name: str) -> None:
    """Raise RunDamagedError unless it is a selection of a suite, of recordings, or of an environment."""
    where = f"{name}: the selection"
    for source in ("recording", "played"):
        if source in selection:
            expect(selection, {source: dict}, where, RESTORE)
            expect(selection[source], {"name": str, "episodes": list}, where, RESTORE)
            return
    expect(selection, _SELECTION, where, RESTORE)
    expect(selection["suite"], {"identity": str, "content_sha256": str, "seed_text": str}, where, RESTORE)
    if "wordings" in selection:
        expect(selection, {"wordings": dict}, where, RESTORE)
        expect(selection["wordings"], {"names": list}, where, RESTORE)


def _check_order(record: PlanRecord, before: int, by_number: Mapping[int, Row], name: str) -> None:
    """Raise RunDamagedError unless new episodes are numbered on from `before`, and all of them have a place."""
    numbers = [row["episode"] for row in record.episodes]
    ids = {row["episode_id"] for row in by_number.values()}
    expected = list(range(before + len(numbers)))
    if numbers != expected[before:] or sorted(record.order) != expected or len(ids) != len(expected):
        raise RunDamagedError(f"{name} numbers or orders its episodes in another way than plans do. {RESTORE}")


def while_growing[Result](location: Location, read: Callable[[], Result]) -> Result:
    """The result of `read`, called again if the run grew meanwhile: parts of two states do not fit together.

    Raises what `read` raises.
    """
    while True:
        before = count_plans(location)
        try:
            return read()
        except RunDamagedError:
            if count_plans(location) == before:
                raise


# -- the card ----------------------------------------------------------------------------------------------------


_SETTINGS = {"model": str, "captured_calls": int, "tokens": str, "codec": str}
"""The settings of every run, and their types."""
_FURTHER = {"random_weights": bool, "suite": dict, "later_views": str}
"""Further settings of every extracted run; a run that other code wrote may lack them."""
_EPISODE = {
    **dict.fromkeys(("episode_id", "item_id", "category", "group_id", "layout", "side_correct"), str),
    "item_content_sha256": str,
    "episode": int,
}
"""The columns of every planned episode of the scene, and their types."""
_STRETCH = {
    **dict.fromkeys(("episode_id", "item_id", "category", "group_id", "instruction", "content_blake2b"), str),
    **dict.fromkeys(("episode", "source_episode", "first_frame", "frame_step", "frames"), int),
}
"""The same of a run on recordings."""
_PLAYED = {
    **dict.fromkeys(("episode_id", "item_id", "category", "group_id", "instruction"), str),
    **dict.fromkeys(("episode", "env_episode", "env_seed"), int),
}
"""The same of a run in an environment of the user's own."""
_INPUTS = {"inputs": dict, "columns": list, "names": dict}
_OF_SOURCES = {DATASET: {"meta_blake2b": str, **_INPUTS}, ENVIRONMENT: {"revision": str, **_INPUTS}}
"""The settings of recordings, or of an environment."""
_CHUNKS = "/c/"
"""Between the name of an array and the position of a chunk in a key of Zarr v3."""


def _distinct(names: list[str]) -> list[str]:
    """The names. Raises ValueError if one stands twice."""
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"{', '.join(twice)} stands twice; expected each name once")
    return names


_Count = Annotated[int, Field(gt=0)]
_Names = Annotated[list[str], AfterValidator(_distinct)]


class StreamEntry(BaseModel):
    """One stream in `run.json`, as `StoredStream`; without `tokens` unless every token is stored."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
    name: str
    layers: _Count
    width: _Count
    iterations: _Count | None
    tokens: _Count = 1
    views: _Names
    part: Part | None
    label: str
    quantities: _Names
    probed: bool
    sums: bool


class Card(Record):
    """`run.json`. objects: metadata of the arrays."""

    kind: ClassVar[str] = "card"
    schema_version: int
    settings: dict[str, Any]
    settings_sha256: str
    streams: list[StreamEntry]
    objects: Sums

    @field_validator("streams")
    @classmethod
    def _check_names(cls, streams: list[StreamEntry]) -> list[StreamEntry]:
        _distinct([stream.name for stream in streams])
        return streams


class LeftOut(Record):
    """`left-out.json`, only in a copy without activations, where objects are missing on purpose.

    arrays: those of `data.zarr` whose objects were not copied; also `directions.npz` where the weights of probes
    were not. Commits still hold the hash of every object.
    """

    kind: ClassVar[str] = "note of what was left out"
    run: str
    arrays: list[str]


def is_left_out(key: str, arrays: Iterable[str]) -> bool:
    """Whether an object of `data.zarr` belongs to one of these arrays; their metadata always exists."""
    array, chunks, _ = key.partition(_CHUNKS)
    return bool(chunks) and array in arrays


@dataclass(frozen=True)
class Root:
    """`run.json`, checked, and the plan that goes with it.

    own_settings: those of the card, without the parts that a selection decides. identity: hash of the card.
    """

    location: Location
    card: Card

    @property
    def identity(self) -> str:
        """The hash of the card, 64 hex digits."""
        return self.card.hash

    @cached_property
    def own_streams(self) -> Mapping[str, StoredStream]:
        """The storage of every stream, by name; with one token where a selection decides their number."""
        entries = [dict(entry) for entry in self.card.streams]
        tuples = [{name: tuple(entry[name]) for name in ("views", "quantities")} for entry in entries]
        return {
            entry["name"]: StoredStream(**{**entry, **lists}) for entry, lists in zip(entries, tuples, strict=True)
        }

    @cached_property
    def metadata(self) -> dict[str, Sum]:
        """Length and hash of the metadata of all arrays, by key in `data.zarr`."""
        return {key.removeprefix(f"{DATA}/"): stored for key, stored in self.card.objects.items()}

    @property
    def own_settings(self) -> dict[str, Any]:
        """The settings of the card."""
        return self.card.settings

    def check_continuable(self) -> None:
        """Raise ActivationsLeftOutError for a copy without activations."""
        if self.left_out:
            self.refuse_left_out("nothing can be added to it")

    @cached_property
    def left_out(self) -> frozenset[str]:
        """The arrays that this run, if it is such a copy, was copied without. Raises RunDamagedError."""
        if not self.location.exists(LEFT_OUT_FILE):
            return frozenset()
        advice = "Make the copy again, with `probe-kit run copy`"
        return frozenset(LeftOut.read(self.location, LEFT_OUT_FILE, advice, run=self.identity).arrays)

    def refuse_left_out(self, why: str) -> NoReturn:
        """Raise ActivationsLeftOutError. why: what is not possible, in words."""
        raise ActivationsLeftOutError(
            f"{self.location} is a copy without its activations ({', '.join(sorted(self.left_out))}): {why}. Use "
            "the run that it was copied from"
        )

    def check(self) -> None:
        """Raise RunDamagedError unless the plan and all metadata are what was written."""
        _ = self.plan
        for key in self.card.objects:
            self.check_metadata(key)

    def check_metadata(self, key: str) -> None:
        """Raise RunDamagedError if the metadata of an array is missing or was changed."""
        name = f"{self.location}/{key}"
        try:
            problem = self.card.objects[key].problem(self.location.read(key))
        except FileNotFoundError:
            problem = "is missing"
        if problem:
            raise RunDamagedError(f"{name} {problem}. {RESTORE}")

    # -- the plan --------------------------------------------------------------------------------------

    @cached_property
    def stored_plan(self) -> StoredPlan:
        """The plan that all plan records make together."""
        return read_plans(self.location, self.identity, self._check_row)

    @property
    def plan(self) -> Sequence[Row]:
        """The planned episodes in order; none in a run that has no plan yet."""
        return self.stored_plan.rows

    @cached_property
    def settings(self) -> dict[str, Any]:
        """The settings of the run and of the selection that it has now: suite, categories, items and wordings."""
        selection = self.stored_plan.selection
        suite = {**self.own_settings.get("suite", {}), **selection.get("suite", {})}
        return {**self.own_settings, **selection, **({"suite": suite} if suite else {})}

    @cached_property
    def streams(self) -> Mapping[str, StoredStream]:
        """The storage of every stream, by name.

        Raises RunDamagedError if the plan lacks the number of tokens of one.
        """
        tokens = self.stored_plan.tokens
        lacking = [
            entry.name
            for entry in self.card.streams
            if "tokens" not in entry.model_fields_set and entry.name not in tokens
        ]
        if lacking and self.plan:
            name = f"{self.location}/{plan_key(len(self.stored_plan.extents) - 1)}"
            raise RunDamagedError(f"{name} says no number of tokens of {lacking[0]}. {RESTORE}")
        return {
            name: replace(stream, tokens=tokens[name]) if name in tokens else stream
            for name, stream in self.own_streams.items()
        }

    def _check_row(self, row: Any, name: str) -> None:
        settings = self.own_settings
        parts = _STRETCH if DATASET in settings else _PLAYED if ENVIRONMENT in settings else _EPISODE
        expect(row if isinstance(row, dict) else {}, parts, name, RESTORE)

    @cached_property
    def planned(self) -> dict[int, dict[str, Any]]:
        """The same by number."""
        return {episode["episode"]: episode for episode in self.plan}

    @cached_property
    def arrays(self) -> dict[str, int]:
        """Arrays of `data.zarr` in which every episode has one object, and how many axes each has."""
        with_tokens = self.own_settings["tokens"] == "all"
        streams = self.own_streams.values()
        arrays = {
            name: axes for stream in streams for name, axes in stream.arrays(with_tokens, self.later_views).items()
        }
        shapes = stored_inputs_of(self.own_settings).get("inputs", {})
        return {**arrays, **{f"{INPUTS}/{name}": 2 + len(shape) for name, shape in shapes.items()}}

    @property
    def has_trajectories(self) -> bool:
        """Whether the run was begun with room for what happens in episodes step by step."""
        return f"{DATA}/{TRAJECTORY}/zarr.json" in self.card.objects

    @property
    def later_views(self) -> LaterViews:
        """Pooled views that are stored of the inferences after the first."""
        return "mean" if self.own_settings.get("later_views") == MEAN_VIEW else "all"

    @property
    def vector_kinds(self) -> tuple[VectorKind, ...]:
        """Arrays of every stream that hold vectors of views."""
        return ("pooled",) if self.later_views == "all" else ("pooled", "later")


def new_card(
    settings: Mapping[str, Any], streams: Iterable[Mapping[str, Any]], objects: Mapping[str, bytes]
) -> Card:
    """The card of a run that begins with these arrays' metadata.

    streams: without the number of tokens, which a selection decides, unless every token is stored.
    """
    return Card(
        schema_version=SCHEMA_VERSION,
        settings=dict(settings),
        settings_sha256=sha256_json(settings),
        streams=[StreamEntry.model_validate(stream) for stream in streams],
        objects={key: Sum.of(content) for key, content in objects.items()},
    )


def read_root(location: Location) -> Root:
    """The root of the run that lies at `location`.

    Raises RunNotFoundError if there is no run, RunDamagedError if `run.json` was changed or has another schema.
    """
    root = find_root(location)
    if root is None:
        raise RunNotFoundError(f"{location} is not a run: it has no {RUN_FILE}. {what_to_open(str(location))}")
    return root


def find_root(location: Location) -> Root | None:
    """The root of the run that lies at `location`, None if there is no run. Raises RunDamagedError."""
    name = f"{location}/{RUN_FILE}"
    try:
        raw = location.read(RUN_FILE)
    except FileNotFoundError:
        return None
    # Before the hash: a record of another schema may be whole, and the message should say which version reads it.
    schema = read_plain(raw, name, RESTORE).get("schema_version")
    if type(schema) is not int or schema != SCHEMA_VERSION:
        raise RunDamagedError(
            f"{name} has schema {schema}; this version of probe_kit reads schema {SCHEMA_VERSION}. Extract the "
            "run again, or read it with the version that made it"
        )
    card = Card.parse(raw, name, RESTORE)
    if sha256_json(card.settings) != card.settings_sha256:
        raise RunDamagedError(f"{name}: the settings do not have the hash stored beside them. {RESTORE}")
    _check_settings(card.settings, name)
    root = Root(location, card)
    if lost := {f"{DATA}/{array}/zarr.json" for array in root.arrays} - {*root.card.objects}:
        raise RunDamagedError(f"{name} names no hash of {min(lost)}. {RESTORE}")
    return root


def _check_settings(settings: Mapping[str, Any], name: str) -> None:
    optional = {part: kind for part, kind in _FURTHER.items() if part in settings}
    expect(settings, {**_SETTINGS, **optional}, f"{name}: the settings", RESTORE)
    for source, parts in _OF_SOURCES.items():
        if source in settings:
            expect(settings, {source: dict}, f"{name}: the settings", RESTORE)
            expect(settings[source], parts, f"{name}: the {source}", RESTORE)


# -- the label ---------------------------------------------------------------------------------------------------


LONGEST_LABEL = 200


class Label(Record):
    """`label.json`: the label, and the identity of the run that it belongs to."""

    kind: ClassVar[str] = "label"
    run: str
    label: str


def label_run(path: Path | str | Location, label: str) -> None:
    """Give the run at `path` another label; nothing else of it changes.

    label: 1 to 200 printable characters. Raises UsageError for another label, RunNotFoundError if there is no run,
    RunDamagedError if `run.json` was changed.
    """
    root = read_root(locate(path))
    check_label(label)
    root.location.write(LABEL_FILE, Label(run=root.identity, label=label).to_bytes())


def check_label(label: str) -> None:
    """Raise UsageError unless tables can call a run so."""
    if not (label.isprintable() and 0 < len(label) <= LONGEST_LABEL):
        raise UsageError(f"label is {label[:LONGEST_LABEL]!r}; expected 1 to {LONGEST_LABEL} printable characters")


def read_label(root: Root) -> str:
    """The label of a run. Raises RunDamagedError if its record is missing, was changed, or is of another run."""
    advice = f"Write it anew: `probe-kit run show {root.location} --label LABEL`"
    return Label.read(root.location, LABEL_FILE, advice, run=root.identity).label
