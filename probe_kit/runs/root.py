"""The root of a run: `run.json`, and what belongs to every run.

It carries settings and streams, the hash of every array's metadata at no episodes, and its own hash, which is the
run's identity: plans and commits name it, so that none counts in another run. The selection of episodes may grow
and is in `plans`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NoReturn

from probe_kit.errors import (
    ActivationsLeftOutError,
    RunDamagedError,
    RunNotFoundError,
)
from probe_kit.hashing import sha256_json
from probe_kit.runs.arrays import at_extent, extent_of
from probe_kit.runs.layout import (
    DATA,
    DATASET,
    ENVIRONMENT,
    INPUTS,
    MEAN_VIEW,
    PLANS,
    RUN_FILE,
    SCHEMA_VERSION,
    LaterViews,
    StoredStream,
    VectorKind,
    stored_inputs_of,
)
from probe_kit.runs.left_out import read_left_out
from probe_kit.runs.plans import RESTORE, Row, StoredPlan, plan_key, read_plans
from probe_kit.runs.records import (
    HASH,
    Sum,
    as_record,
    check_sums,
    expect,
    is_record,
    read_plain,
    read_record,
    read_sums,
)
from probe_kit.runs.store import Location
from probe_kit.runs.summary import what_to_open

_PARTS = {"settings": dict, "settings_sha256": str, "streams": list, "objects": dict}
_SETTINGS = {"model": str, "captured_calls": int, "tokens": str, "codec": str}
_FURTHER = {"random_weights": bool, "suite": dict, "later_views": str}
"""What the settings of every extracted run say besides, and those of a run that other code wrote may not."""
_EPISODE = {
    **dict.fromkeys(("episode_id", "item_id", "category", "group_id", "layout", "side_correct"), str),
    "item_content_sha256": str,
    "episode": int,
}
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
"""What settings say of recordings, or of an environment."""


@dataclass(frozen=True)
class Root:
    """What `run.json` says, checked, and the plan that goes with it.

    card: as it is stored. own_settings: those of the card, without what a selection decides. identity:
    the hash that was computed of it. own_streams: as it stores them, by name. sums: of the arrays' metadata, at no
    episodes.
    """

    location: Location
    card: Mapping[str, Any]
    own_settings: dict[str, Any]
    identity: str
    own_streams: Mapping[str, StoredStream]
    sums: Mapping[str, Sum]

    def check_continuable(self) -> None:
        """Raise ActivationsLeftOutError for a copy without activations."""
        if self.left_out:
            self.refuse_left_out("nothing can be added to it")

    @cached_property
    def left_out(self) -> frozenset[str]:
        """The arrays that this run, if it is such a copy, was copied without. Raises RunDamagedError."""
        return read_left_out(self.location, self.identity)

    def refuse_left_out(self, why: str) -> NoReturn:
        """Raise ActivationsLeftOutError. why: what is not possible, in words."""
        raise ActivationsLeftOutError(
            f"{self.location} is a copy without its activations ({', '.join(sorted(self.left_out))}): {why}. Use "
            "the run that it was copied from"
        )

    # -- what belongs to every run ---------------------------------------------------------------------

    def read(self, key: str) -> bytes:
        """An object that belongs to every run, as stored.

        Raises RunDamagedError if it is missing or was changed.
        """
        name = f"{self.location}/{key}"
        try:
            content = self.location.read(key)
        except FileNotFoundError:
            raise RunDamagedError(f"{name} is missing. {RESTORE}") from None
        if problem := self._problem(key, content):
            raise RunDamagedError(f"{name} {problem}. {RESTORE}")
        return content

    def _problem(self, key: str, content: bytes) -> str | None:
        """What is wrong with an object. An array may still have the room of a former plan record."""
        try:
            extent, begun = extent_of(content), at_extent(content, 0)
            spelt = at_extent(content, extent or 0) == content
        except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError):
            return "has other bytes than were written"
        if problem := self.sums[key].problem(begun):
            return problem
        if spelt and extent is not None and extent > len(self.plan):
            return (
                f"has room for {extent} episodes, and {len(self.plan)} are planned; either it was changed, or a "
                f"file of {PLANS} is missing, which the `probe-kit extract` that let the run grow writes again"
            )
        known = spelt and extent in (None, 0, *self.stored_plan.extents)
        return None if known else "has other bytes than were written"

    def check(self) -> None:
        """Raise RunDamagedError unless the plan and all metadata are what was written."""
        _ = self.plan, self._stored

    @cached_property
    def _stored(self) -> Mapping[str, bytes]:
        """What `read` gives, by key."""
        return {key: self.read(key) for key in self.sums}

    @cached_property
    def metadata(self) -> dict[str, bytes]:
        """The arrays' metadata with room for every planned episode, by key in `data.zarr`.

        Raises RunDamagedError if stored metadata is missing or was changed.
        """
        inside, planned = f"{DATA}/", len(self.plan)
        stored = {key.removeprefix(inside): one for key, one in self._stored.items() if key.startswith(inside)}
        return {key: at_extent(content, planned) for key, content in stored.items()}

    def widened(self) -> Mapping[str, bytes]:
        """By key in the run, what to write over metadata that has room for fewer episodes than are planned."""
        return {key: at_extent(self._stored[key], len(self.plan)) for key in self.narrow}

    @cached_property
    def narrow(self) -> Mapping[str, int]:
        """Metadata on the disk that has room for fewer episodes than are planned, by key in the run, and how many.

        So it is between a plan record and the rewriting of the metadata. `metadata` is not concerned.
        """
        inside, planned = f"{DATA}/", len(self.plan)
        extents = {key: extent_of(one) for key, one in self._stored.items() if key.startswith(inside)}
        return {key: room for key, room in extents.items() if room is not None and room < planned}

    def check_room(self, numbers: Iterable[int]) -> None:
        """Raise RunDamagedError if an episode of these numbers has no room in an array, as the disk has it."""
        highest = max(numbers, default=-1)
        for key, room in self.narrow.items():
            if room <= highest:
                raise RunDamagedError(
                    f"{self.location}/{key} has room for {room} episodes, and episode {highest} is committed. The "
                    "same `probe-kit extract` writes it again"
                )

    # -- the plan --------------------------------------------------------------------------------------

    @cached_property
    def stored_plan(self) -> StoredPlan:
        """The plan that all plan records make together."""
        return read_plans(self.location, self.identity, self._check_row)

    @property
    def plan(self) -> Sequence[Row]:
        """The planned episodes in order; none in a run that has no plan yet."""
        return self.stored_plan.rows

    @property
    def suite_parent(self) -> str | None:
        """Content hash of the suite that the run's suite was selected from.

        None for a whole suite.
        """
        return self.stored_plan.suite_parent

    @cached_property
    def settings(self) -> dict[str, Any]:
        """Those of the run and of the selection that it has now: suite, categories, items and wordings."""
        selection = self.stored_plan.selection
        suite = {**self.own_settings.get("suite", {}), **selection.get("suite", {})}
        return {**self.own_settings, **selection, **({"suite": suite} if suite else {})}

    @cached_property
    def streams(self) -> Mapping[str, StoredStream]:
        """How the streams lie in the store, by name.

        Raises RunDamagedError if the plan lacks the number of tokens of one.
        """
        tokens = self.stored_plan.tokens
        lacking = [
            one["name"] for one in self.card["streams"] if "tokens" not in one and one["name"] not in tokens
        ]
        if lacking and self.plan:
            name = f"{self.location}/{plan_key(len(self.stored_plan.extents) - 1)}"
            raise RunDamagedError(f"{name} says no number of tokens of {lacking[0]}. {RESTORE}")
        return {
            name: replace(one, tokens=tokens[name]) if name in tokens else one
            for name, one in self.own_streams.items()
        }

    def _check_row(self, row: Any, name: str) -> None:
        expect(row if isinstance(row, dict) else {}, self._episode_parts, name, RESTORE)

    @property
    def _episode_parts(self) -> dict[str, type]:
        if DATASET in self.own_settings:
            return _STRETCH
        if ENVIRONMENT in self.own_settings:
            return _PLAYED
        return _EPISODE

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
            name: axes for one in streams for name, axes in one.arrays(with_tokens, self.later_views).items()
        }
        shapes = stored_inputs_of(self.own_settings).get("inputs", {})
        return {**arrays, **{f"{INPUTS}/{name}": 2 + len(shape) for name, shape in shapes.items()}}

    @property
    def later_views(self) -> LaterViews:
        """Pooled views that are stored of the inferences after the first."""
        return "mean" if self.own_settings.get("later_views") == MEAN_VIEW else "all"

    @property
    def vector_kinds(self) -> tuple[VectorKind, ...]:
        """Arrays of every stream that hold vectors of views."""
        return ("pooled",) if self.later_views == "all" else ("pooled", "later")


def new_root(settings: Mapping[str, Any], streams: list[dict[str, Any]], objects: Mapping[str, bytes]) -> bytes:
    """The `run.json` of a run that begins with these arrays' metadata, at no episodes.

    streams: without the number of tokens, which a selection decides, unless every token is stored.
    """
    return as_record(
        {
            "schema_version": SCHEMA_VERSION,
            "settings": settings,
            "settings_sha256": sha256_json(settings),
            "streams": streams,
            "objects": {key: Sum.of(content).to_json() for key, content in objects.items()},
        }
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
    card = _read_card(raw, name)
    expect(card, _PARTS, name, RESTORE)
    if sha256_json(card["settings"]) != card["settings_sha256"]:
        raise RunDamagedError(f"{name}: the settings do not have the hash stored beside them. {RESTORE}")
    settings = dict(card["settings"])
    there = {part: kind for part, kind in _FURTHER.items() if part in settings}
    expect(settings, {**_SETTINGS, **there}, f"{name}: the settings", RESTORE)
    for source, parts in _OF_SOURCES.items():
        if source in settings:
            expect(settings, {source: dict}, f"{name}: the settings", RESTORE)
            expect(settings[source], parts, f"{name}: the {source}", RESTORE)
    check_sums(card["objects"], name, RESTORE)
    streams = _read_streams(card["streams"], name)
    root = Root(location, card, settings, card[HASH], streams, read_sums(card["objects"]))
    if lost := {f"{DATA}/{array}/zarr.json" for array in root.arrays} - {*root.sums}:
        raise RunDamagedError(f"{name} names no hash of {min(lost)}. {RESTORE}")
    return root


def _read_card(raw: bytes, name: str) -> dict[str, Any]:
    """The content of `run.json`. Raises RunDamagedError, which names the schema where it is another one."""
    card = read_record(raw, name, RESTORE) if is_record(raw) else read_plain(raw, name, RESTORE)
    schema = card.get("schema_version")
    if type(schema) is not int or schema != SCHEMA_VERSION:
        raise RunDamagedError(
            f"{name} has schema {schema}; this version of probe_kit reads schema {SCHEMA_VERSION}. Extract the "
            "run again, or read it with the version that made it"
        )
    return read_record(raw, name, RESTORE)


def _read_streams(stored: list[Any], name: str) -> dict[str, StoredStream]:
    try:
        streams = [StoredStream.from_json({"tokens": 1, **one}) for one in stored]
    except (TypeError, ValueError, KeyError) as error:
        raise RunDamagedError(f"{name} describes its streams wrongly: {error!r}. {RESTORE}") from error
    if len({stream.name for stream in streams}) < len(streams):
        raise RunDamagedError(f"{name} describes two streams of one name. {RESTORE}")
    return {stream.name: stream for stream in streams}
