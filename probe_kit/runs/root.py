"""The root of a run: `run.json` with the plan that goes with it, and its label.

    run.json      settings, streams, hashes of all arrays' metadata, and its own: the run's identity
    label.json    the name of the run in tables, which may be changed at any time

Plans and commits name the identity, so that none counts in another run. `run.json` knows of no selection, so two
runs of other items have one identity.
"""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NoReturn, NotRequired, TypedDict, cast

from pydantic import ConfigDict, field_serializer, field_validator

from probe_kit._system.escaping import as_argument
from probe_kit.errors import ActivationsLeftOutError, RunDamagedError, RunNotFoundError, UsageError
from probe_kit.hashing import sha256_json
from probe_kit.runs.array_lengths import with_length, without_length
from probe_kit.runs.layout import (
    DATA,
    DATASET,
    ENVIRONMENT,
    INPUTS,
    LABEL_FILE,
    LEFT_OUT_FILE,
    MEAN_VIEW,
    RUN_FILE,
    SCHEMA_VERSION,
    TRAJECTORY,
    LaterViews,
    StoredStream,
    VectorKind,
    check_distinct,
    source_settings_of,
)
from probe_kit.runs.plan import PlanRecord, RowColumns, StoredPlan, plan_key, read_plans
from probe_kit.runs.records import RESTORE, Checksum, Record, Sums, read_plain
from probe_kit.runs.run_folders import what_to_open
from probe_kit.runs.store import Location, locate

# -- the card ----------------------------------------------------------------------------------------------------


class _Inputs(TypedDict):
    """Recordings or an environment, with shapes and names of the stored inputs."""

    __pydantic_config__ = ConfigDict(extra="allow", strict=True)  # type: ignore[misc]  # pydantic's way
    inputs: dict[str, Any]
    columns: list[str]
    names: dict[str, Any]
    meta_blake2b: NotRequired[str]
    revision: NotRequired[str | None]


class _Settings(TypedDict):
    """The settings of every run, and those that a run which other code wrote may lack."""

    __pydantic_config__ = ConfigDict(extra="allow", strict=True)  # type: ignore[misc]
    model: str
    captured_calls: int
    tokens: str
    codec: str
    random_weights: NotRequired[bool]
    suite: NotRequired[dict[str, Any]]
    later_views: NotRequired[str]
    dataset: NotRequired[_Inputs]
    environment: NotRequired[_Inputs]


_OF_SCENES = ("layout", "side_correct", "item_content_sha256")
_OF_RECORDINGS = ("instruction", "content_blake2b", "source_episode", "first_frame", "frame_step", "frames")
_OF_ENVIRONMENTS = ("instruction", "env_episode", "env_seed")
"""The columns that every planned row of an environment has; those above are of scenes and of recordings."""
_CHUNKS = "/c/"
"""The part between the name of an array and the position of a chunk in a key of Zarr v3."""


class Card(Record):
    """The record `run.json`.

    Attributes:
        objects: The sums of the metadata of the arrays.
    """

    kind: ClassVar[str] = "card"
    schema_version: int
    settings: _Settings
    settings_sha256: str
    streams: list[StoredStream]
    objects: Sums

    @field_validator("streams", mode="before")
    @classmethod
    def _with_one_token(cls, streams: Any) -> Any:
        """Give streams one token where a selection decides their number."""
        if not isinstance(streams, list):
            return streams  # which the field's own type refuses
        return [{"tokens": 1, **stream} if isinstance(stream, dict) else stream for stream in streams]

    @field_validator("streams")
    @classmethod
    def _check_names(cls, streams: list[StoredStream]) -> list[StoredStream]:
        check_distinct([stream.name for stream in streams])
        return streams

    @field_serializer("streams")
    def _without_selected_tokens(self, streams: list[StoredStream]) -> list[dict[str, Any]]:
        """Leave the number of tokens out, unless arrays are as long as that."""
        selected = () if self.settings["tokens"] == "all" else ("tokens",)
        entries = [asdict(stream) for stream in streams]
        return [{name: value for name, value in entry.items() if name not in selected} for entry in entries]


class LeftOut(Record):
    """The record `left-out.json`, only in a copy without activations, where objects are missing on purpose.

    Commits still hold the hash of every object.

    Attributes:
        arrays: The arrays of `data.zarr` whose objects were not copied; also `directions.npz` where the weights of
            probes were not.
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
    """The record `run.json` of a run, with its plan.

    Attributes:
        location: The folder or URL of the run.
        card: The record itself: settings, streams, and the hashes of the arrays' metadata.
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
        return {stream.name: stream for stream in self.card.streams}

    @cached_property
    def metadata(self) -> dict[str, Checksum]:
        """The length and hash of the metadata of all arrays, by key in `data.zarr`."""
        return {key.removeprefix(f"{DATA}/"): stored for key, stored in self.card.objects.items()}

    @property
    def own_settings(self) -> dict[str, Any]:
        """The settings of the card, without the parts that a selection decides."""
        return cast("dict[str, Any]", self.card.settings)

    def check_continuable(self) -> None:
        """Raise ActivationsLeftOutError for a copy without activations."""
        if self.left_out:
            self.refuse_left_out("nothing can be added to it")

    @cached_property
    def left_out(self) -> frozenset[str]:
        """The arrays that a copy without activations lacks; empty for any other run. Raises RunDamagedError."""
        if not self.location.exists(LEFT_OUT_FILE):
            return frozenset()
        advice = "Make the copy again, with `probe-kit run copy`"
        return frozenset(LeftOut.read(self.location, LEFT_OUT_FILE, advice, run=self.identity).arrays)

    def refuse_left_out(self, why: str) -> NoReturn:
        """Raise ActivationsLeftOutError; `why` says what is not possible, in words."""
        raise ActivationsLeftOutError(
            f"{self.location} is a copy without its activations ({', '.join(sorted(self.left_out))}): {why}. Use "
            "the run that it was copied from"
        )

    def check(self) -> None:
        """Raise RunDamagedError unless the plan and all metadata are what was written."""
        _ = self.plan, self.stored_metadata

    @cached_property
    def stored_metadata(self) -> dict[str, bytes]:
        """The metadata of all arrays as it is stored now, by key; see `array_lengths`. Raises RunDamagedError."""
        return {key: self.read_metadata(key) for key in self.card.objects}

    def read_metadata(self, key: str) -> bytes:
        """Return the stored metadata of an array or group. Raises RunDamagedError if it is missing or changed."""
        expected = self.card.objects[key]
        try:
            stored = self.location.read(key)
        except FileNotFoundError:
            raise RunDamagedError(f"{self.location}/{key} is missing. {RESTORE}") from None
        problem = expected.problem(stored)
        if problem and expected.problem(without_length(stored)):
            raise RunDamagedError(f"{self.location}/{key} {problem}. {RESTORE}")
        return stored

    def set_lengths(self) -> None:
        """Make the arrays as long as the plan for other tools, wherever they are not."""
        episodes = len(self.plan)
        sized = {key: with_length(without_length(raw), episodes) for key, raw in self.stored_metadata.items()}
        changed = [key for key, content in sized.items() if content != self.stored_metadata[key]]
        with ThreadPoolExecutor(max(1, len(changed))) as writers:  # each takes a round trip
            list(writers.map(lambda key: self.location.write(key, sized[key]), changed))
        self.stored_metadata.update(sized)

    # -- the plan --------------------------------------------------------------------------------------

    def with_record(self, record: PlanRecord) -> "Root":
        """Return the root of the run after a further plan record, without reading those before again."""
        grown = Root(self.location, self.card)
        grown.__dict__["stored_plan"] = self.stored_plan.with_record(record)  # the cache of `cached_property`
        return grown

    @cached_property
    def stored_plan(self) -> StoredPlan:
        """The plan that all plan records make together."""
        settings = self.own_settings
        of_source = _OF_ENVIRONMENTS if ENVIRONMENT in settings else _OF_SCENES
        columns = _OF_RECORDINGS if DATASET in settings else of_source
        return read_plans(self.location, self.identity, columns)

    @property
    def plan(self) -> Sequence[RowColumns]:
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

        Raises:
            RunDamagedError: If the plan lacks the number of tokens of a stream.
        """
        tokens = self.stored_plan.tokens
        selected = self.own_streams if self.own_settings["tokens"] != "all" else ()
        lacking = [name for name in selected if name not in tokens]
        if lacking and self.plan:
            name = f"{self.location}/{plan_key(len(self.stored_plan.extents) - 1)}"
            raise RunDamagedError(f"{name} says no number of tokens of {lacking[0]}. {RESTORE}")
        return {
            name: replace(stream, tokens=tokens[name]) if name in tokens else stream
            for name, stream in self.own_streams.items()
        }

    @cached_property
    def planned(self) -> dict[int, RowColumns]:
        """The planned episodes by number."""
        return {episode["episode"]: episode for episode in self.plan}

    @cached_property
    def arrays(self) -> dict[str, int]:
        """The arrays of `data.zarr` in which every episode has one object, with the number of axes of each."""
        with_tokens = self.own_settings["tokens"] == "all"
        streams = self.own_streams.values()
        arrays = {
            name: axes for stream in streams for name, axes in stream.arrays(with_tokens, self.later_views).items()
        }
        shapes = source_settings_of(self.own_settings).get("inputs", {})
        return {**arrays, **{f"{INPUTS}/{name}": 2 + len(shape) for name, shape in shapes.items()}}

    @property
    def has_trajectories(self) -> bool:
        """Whether the run was begun with room for what happens in episodes step by step."""
        return f"{DATA}/{TRAJECTORY}/zarr.json" in self.card.objects

    @property
    def later_views(self) -> LaterViews:
        """The pooled views that are stored of the inferences after the first."""
        return "mean" if self.own_settings.get("later_views") == MEAN_VIEW else "all"

    @property
    def vector_kinds(self) -> tuple[VectorKind, ...]:
        """The arrays of every stream that hold vectors of views."""
        return ("pooled",) if self.later_views == "all" else ("pooled", "later")


def new_card(settings: Mapping[str, Any], streams: Iterable[StoredStream], objects: Mapping[str, bytes]) -> Card:
    """Return the card of a run that begins with these arrays' metadata."""
    return Card(
        schema_version=SCHEMA_VERSION,
        settings=cast("_Settings", dict(settings)),
        settings_sha256=sha256_json(settings),
        streams=list(streams),
        objects={key: Checksum.of(content) for key, content in objects.items()},
    )


def read_root(location: Location) -> Root:
    """Return the root of the run at `location`.

    Raises:
        RunNotFoundError: If there is no run.
        RunDamagedError: If `run.json` was changed or has another schema.
    """
    root = find_root(location)
    if root is None:
        raise RunNotFoundError(
            f"{location} is not a run: there is no {location}/{RUN_FILE}. {what_to_open(str(location))}"
        )
    return root


def find_continuable(location: Location) -> Root | None:
    """Return the root as `find_root` does. Raises ActivationsLeftOutError for a copy without activations.

    Nothing can be added to such a copy.
    """
    root = find_root(location)
    if root is not None:
        root.check_continuable()
    return root


def find_root(location: Location) -> Root | None:
    """Return the root of the run at `location`, None if there is no run. Raises RunDamagedError."""
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
    if sha256_json(cast("dict[str, Any]", card.settings)) != card.settings_sha256:
        raise RunDamagedError(f"{name}: the settings do not have the hash stored beside them. {RESTORE}")
    root = Root(location, card)
    if lost := {f"{DATA}/{array}/zarr.json" for array in root.arrays} - {*root.card.objects}:
        raise RunDamagedError(f"{name} names no hash of {min(lost)}. {RESTORE}")
    return root


# -- the label ---------------------------------------------------------------------------------------------------


LONGEST_LABEL = 200


class Label(Record):
    """The record `label.json`: the label, and the identity of the run that it belongs to."""

    kind: ClassVar[str] = "label"
    run: str
    label: str


def label_run(path: Path | str | Location, label: str) -> None:
    """Give the run at `path` another label of 1 to 200 printable characters; nothing else of it changes.

    Raises:
        UsageError: For another label.
        RunNotFoundError: If there is no run.
        RunDamagedError: If `run.json` was changed.
    """
    root = read_root(locate(path))
    check_label(label)
    root.location.write(LABEL_FILE, Label(run=root.identity, label=label).to_bytes())


def check_label(label: str) -> None:
    """Raise UsageError unless the label is allowed in tables."""
    if not (label.isprintable() and 0 < len(label) <= LONGEST_LABEL):
        raise UsageError(f"label is {label[:LONGEST_LABEL]!r}; expected 1 to {LONGEST_LABEL} printable characters")


def read_label(root: Root) -> str:
    """Return a run's label. Raises RunDamagedError if its record is missing, changed, or of another run."""
    advice = f"Write it anew: `probe-kit run show {as_argument(root.location)} --label LABEL`"
    return Label.read(root.location, LABEL_FILE, advice, run=root.identity).label
