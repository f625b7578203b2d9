"""The root of a run: `run.json`, and the objects whose hashes it holds.

It carries settings and streams, the hashes of the plan and of every array's metadata, and its own hash, which is
the run's identity: commits name it, so that none counts in another run.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NoReturn

from probe_kit.errors import (
    ActivationsLeftOutError,
    RunDamagedError,
    RunNotFoundError,
    SettingsMismatchError,
)
from probe_kit.extract.run_layout import (
    DATA,
    PLAN_FILE,
    READABLE_SCHEMAS,
    RUN_FILE,
    SCHEMA_VERSION,
    StoredStream,
)
from probe_kit.extract.store.format.hashes import (
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
from probe_kit.extract.store.format.left_out import read_left_out
from probe_kit.extract.store.format.stored_words import in_current_words
from probe_kit.extract.store.locations.location import Location
from probe_kit.extract.store.locations.summary import what_to_open
from probe_kit.hashing import sha256_json

_PARTS = {"settings": dict, "settings_sha256": str, "streams": list, "objects": dict}
_SETTINGS = {"model": str, "captured_calls": int, "tokens": str, "codec": str}
_FURTHER = {"random_weights": bool, "suite": dict}
"""What the settings of every extracted run say besides, and those of a run that other code wrote may not."""
_EPISODE = {
    **dict.fromkeys(("episode_id", "item_id", "category", "group_id", "layout", "side_correct"), str),
    "episode": int,
}
_WITH_ITEM_HASHES = 4
"""The first schema whose plan holds item hashes and the suite's parent."""
RESTORE = "Restore it from a copy, or extract the run again"


@dataclass(frozen=True)
class Root:
    """What `run.json` says, checked.

    card: as it is stored. settings: those of the card, in the words of now. identity: the hash that was computed
    of it. streams: as it stores them, by name. sums: of the plan and the arrays' metadata, by key.
    """

    location: Location
    card: Mapping[str, Any]
    settings: dict[str, Any]
    identity: str
    streams: Mapping[str, StoredStream]
    sums: Mapping[str, Sum]

    @property
    def schema(self) -> int:
        """The schema that the run was written in."""
        return int(self.card["schema_version"])

    def check_continuable(self) -> None:
        """Raise SettingsMismatchError unless this version writes runs of this schema.

        Raises ActivationsLeftOutError for a copy without activations.
        """
        if self.left_out:
            self.refuse_left_out("nothing can be added to it")
        if self.schema != SCHEMA_VERSION:
            raise SettingsMismatchError(
                f"{self.location} holds a run of schema {self.schema}, which an earlier version of probe_kit "
                f"wrote; this one writes schema {SCHEMA_VERSION} only. The run can be read, probed and "
                "compared, but not continued. Choose another --out, or finish it with the version that began it"
            )

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

    def read(self, key: str) -> bytes:
        """An object that belongs to every run. Raises RunDamagedError if it is missing or was changed."""
        name = f"{self.location}/{key}"
        try:
            content = self.location.read(key)
        except FileNotFoundError:
            raise RunDamagedError(f"{name} is missing. {RESTORE}") from None
        if problem := self.sums[key].problem(content):
            raise RunDamagedError(f"{name} {problem}. {RESTORE}")
        return content

    def check(self) -> None:
        """Raise RunDamagedError unless the plan and all metadata are what was written."""
        for key in self.sums:
            self.read(key)

    @cached_property
    def plan(self) -> list[dict[str, Any]]:
        """The planned episodes in order."""
        name, parts = f"{self.location}/{PLAN_FILE}", self._episode_parts
        plan: list[dict[str, Any]] = []
        for episode in self._plan_file["episodes"]:
            row = in_current_words(episode, "plan") if isinstance(episode, dict) else {}
            expect(row, parts, name, RESTORE)
            plan.append(row)
        if len({episode["episode"] for episode in plan}) < len(plan):
            raise RunDamagedError(f"{name} plans two episodes of one number. {RESTORE}")
        return plan

    @property
    def _episode_parts(self) -> dict[str, type]:
        return _EPISODE if self.schema < _WITH_ITEM_HASHES else {**_EPISODE, "item_content_sha256": str}

    @cached_property
    def _plan_file(self) -> dict[str, Any]:
        name = f"{self.location}/{PLAN_FILE}"
        content = read_plain(self.read(PLAN_FILE), name, RESTORE)
        expect(content, {"episodes": list}, name, RESTORE)
        if self.schema >= _WITH_ITEM_HASHES and not isinstance(content.get("suite_parent", ...), str | None):
            raise RunDamagedError(f"{name} does not say what its suite was selected from. {RESTORE}")
        return content

    @property
    def suite_parent(self) -> str | None:
        """Content hash of the suite that the run's suite was selected from.

        None for a whole suite, and in runs of schema 3, which do not say it.
        """
        parent: str | None = self._plan_file.get("suite_parent")
        return parent

    @cached_property
    def planned(self) -> dict[int, dict[str, Any]]:
        """The same by number."""
        return {episode["episode"]: episode for episode in self.plan}

    @cached_property
    def metadata(self) -> dict[str, Sum]:
        """Sums of the arrays' metadata, by key in `data.zarr`."""
        inside = f"{DATA}/"
        return {key.removeprefix(inside): one for key, one in self.sums.items() if key.startswith(inside)}

    @cached_property
    def arrays(self) -> dict[str, int]:
        """Arrays of `data.zarr` in which every episode has one object, and how many axes each has."""
        with_tokens = self.settings["tokens"] == "all"
        return {name: axes for one in self.streams.values() for name, axes in one.arrays(with_tokens).items()}


def new_root(settings: Mapping[str, Any], streams: list[dict[str, Any]], objects: Mapping[str, bytes]) -> bytes:
    """The `run.json` of a run that begins with these other objects."""
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
    settings = in_current_words(card["settings"], "settings")
    there = {part: kind for part, kind in _FURTHER.items() if part in settings}
    expect(settings, {**_SETTINGS, **there}, f"{name}: the settings", RESTORE)
    check_sums(card["objects"], name, RESTORE)
    streams = _read_streams(card["streams"], name)
    root = Root(location, card, settings, card[HASH], streams, read_sums(card["objects"]))
    if lost := {PLAN_FILE, *(f"{DATA}/{array}/zarr.json" for array in root.arrays)} - {*root.sums}:
        raise RunDamagedError(f"{name} names no hash of {min(lost)}. {RESTORE}")
    return root


def _read_card(raw: bytes, name: str) -> dict[str, Any]:
    """What `run.json` says. Runs of former versions carried no hash of their own; their schema is named."""
    card = read_record(raw, name, RESTORE) if is_record(raw) else read_plain(raw, name, RESTORE)
    if (schema := card.get("schema_version")) not in READABLE_SCHEMAS or type(schema) is not int:
        newer = type(schema) is int and schema > SCHEMA_VERSION
        raise RunDamagedError(
            f"{name} has schema {schema}; this version of probe_kit reads schemas "
            f"{' and '.join(map(str, READABLE_SCHEMAS))}. "
            + ("Update probe_kit" if newer else "Extract the run again, or read it with the version that made it")
        )
    return read_record(raw, name, RESTORE)


def _read_streams(stored: list[Any], name: str) -> dict[str, StoredStream]:
    try:
        streams = [StoredStream.from_json(in_current_words(dict(one), "stream")) for one in stored]
    except (TypeError, ValueError, KeyError) as error:
        raise RunDamagedError(f"{name} describes its streams wrongly: {error!r}. {RESTORE}") from error
    if len({stream.name for stream in streams}) < len(streams):
        raise RunDamagedError(f"{name} describes two streams of one name. {RESTORE}")
    return {stream.name: stream for stream in streams}
