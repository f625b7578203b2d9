"""The root of a run: `run.json`, and what it vouches for.

It carries settings and streams, the hashes of the plan and of every array's metadata, and its own hash, which is
the run's identity: commits name it, so that none counts in another run.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from probe_kit.errors import RunDamagedError, RunNotFoundError
from probe_kit.extract.run_layout import DATA, PLAN_FILE, PROTECTED_SINCE, READABLE, RUN_FILE, SCHEMA_VERSION
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
from probe_kit.extract.store.locations.location import Location
from probe_kit.extract.store.locations.summary import what_to_open
from probe_kit.hashing import sha256_json

_PARTS = {"settings": dict, "settings_sha256": str, "streams": list}
_EPISODE = {"episode": int, "episode_id": str}
RESTORE = "Restore it from a copy, or extract the run again"


@dataclass(frozen=True)
class Root:
    """What `run.json` says, checked.

    identity: its hash; None for a run of a former version, which nothing protects.
    sums: of the plan and the arrays' metadata, by key; empty for such a run.
    """

    location: Location
    card: Mapping[str, Any]
    identity: str | None
    sums: Mapping[str, Sum]

    @property
    def protected(self) -> bool:
        """Whether a changed byte anywhere in the run is found."""
        return self.identity is not None

    def read(self, key: str) -> bytes:
        """An object that belongs to every run. Raises RunDamagedError if it is missing or was changed."""
        name = f"{self.location}/{key}"
        try:
            content = self.location.read(key)
        except FileNotFoundError:
            raise RunDamagedError(f"{name} is missing. {RESTORE}") from None
        if self.protected and (problem := self.sums[key].problem(content)):
            raise RunDamagedError(f"{name} {problem}. {RESTORE}")
        return content

    def check(self) -> None:
        """Raise RunDamagedError unless the plan and all metadata are what was written."""
        for key in self.sums:
            self.read(key)

    @cached_property
    def plan(self) -> list[dict[str, Any]]:
        """The planned episodes in order."""
        name = f"{self.location}/{PLAN_FILE}"
        content = read_plain(self.read(PLAN_FILE), name, RESTORE)
        expect(content, {"episodes": list}, name, RESTORE)
        plan: list[dict[str, Any]] = content["episodes"]
        for episode in plan:
            expect(episode if isinstance(episode, dict) else {}, _EPISODE, name, RESTORE)
        return plan

    @cached_property
    def planned(self) -> dict[int, dict[str, Any]]:
        """The same by number."""
        return {episode["episode"]: episode for episode in self.plan}

    @cached_property
    def metadata(self) -> dict[str, Sum]:
        """Sums of the arrays' metadata, by key in `data.zarr`."""
        inside = f"{DATA}/"
        return {key.removeprefix(inside): one for key, one in self.sums.items() if key.startswith(inside)}


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
    name = f"{location}/{RUN_FILE}"
    try:
        raw = location.read(RUN_FILE)
    except FileNotFoundError:
        raise RunNotFoundError(
            f"{location} is not a run: it has no {RUN_FILE}. {what_to_open(str(location))}"
        ) from None
    card = read_record(raw, name, RESTORE) if is_record(raw) else read_plain(raw, name, RESTORE)
    schema = card.get("schema_version")
    if schema not in READABLE:
        raise RunDamagedError(
            f"{location} has schema {schema}; this version of probe_kit reads {', '.join(map(str, READABLE))}. "
            "Update it"
        )
    expect(card, _PARTS, name, RESTORE)
    identity = card.get(HASH)
    if identity is None and schema >= PROTECTED_SINCE:
        raise RunDamagedError(f"{name} has lost the hash it was written with. {RESTORE}")
    return Root(location, card, identity, read_sums(card["objects"]) if identity else {})
