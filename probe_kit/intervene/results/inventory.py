"""The stored interventions of a run, for `probe-kit run show`."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from probe_kit._system.counting import counted
from probe_kit.intervene.kinds import kind_names, kind_of
from probe_kit.intervene.outcomes import StoredIntervention, read_interventions, stored_interventions
from probe_kit.intervene.results.results import effects_of
from probe_kit.runs.reader import RunReader
from probe_kit.runs.results import Bundle
from probe_kit.runs.run import Run

COMMON = frozenset(
    {"format", "kind", "run_settings", "stamp", "weights", "wording", "categories", "items", "readout", "donors"}
)
"""Settings of every intervention; the rest of its settings is its kind's own."""


@dataclass(frozen=True)
class ListedIntervention:
    """One stored intervention.

    state: `used` by verdicts, tables and figures, or of a kind that none of them reads; `other` if others say all
    that it says, of more episodes or newly; `other episodes` if the run has others by now. parameters: the
    settings of its kind alone, as stored.
    """

    key: str
    state: str
    created: str
    kind: str
    categories: tuple[str, ...]
    items: int | None
    wording: str
    parameters: Mapping[str, Any]

    @property
    def words(self) -> str:
        """Return a line about it."""
        settings = [
            f"{name} {_plain(value)}" for name, value in self.parameters.items() if value not in (None, [])
        ]
        parts = [self.kind, f"of {', '.join(self.categories)}"]
        parts += [] if self.items is None else [f"{counted(self.items, 'item')} each"]
        parts += [f"wording {self.wording}"] * bool(self.wording)
        if self.state == "other":
            settings.append("another one stands in its place in tables")
        if self.state == "other episodes":
            settings.append("of other episodes than the run has now")
        return "; ".join([" ".join(parts[:2]), *parts[2:], *settings, self._when])

    @property
    def _when(self) -> str:
        return f"made {self.created[:16].replace('T', ' ')} UTC"


def listed_interventions(run: Any) -> list[ListedIntervention]:
    """All of a run, oldest first. Raises RunDamagedError if one was changed."""
    wordings = run.wordings
    readers: list[RunReader] = [run.in_wording(name) for name in wordings] or [run]
    current = {intervention.key for reader in readers for intervention in stored_interventions(reader)}
    used = {key for reader in readers for key in _used(reader)}
    listed = [_listed(bundle, current, used) for bundle in read_interventions(run.location).values()]
    return sorted(listed, key=lambda intervention: (intervention.created, intervention.key))


def _used(run: RunReader) -> set[str]:
    """Keys of what is read, and of the kinds of which nothing takes another's place."""
    by_kind: dict[str, list[str]] = {}
    for intervention in stored_interventions(run):
        by_kind.setdefault(str(intervention.settings["kind"]), []).append(intervention.key)
    used: set[str] = set()
    for name, keys in by_kind.items():
        preferred = kind_of(name).keys_in_use(run) if name in kind_names() else None
        used |= set(keys) if preferred is None else preferred
    return used


def _listed(bundle: Bundle, current: set[str], used: set[str]) -> ListedIntervention:
    settings, created = bundle.head["settings"], bundle.times.get("created", "")
    state = "used" if bundle.key in used else "other" if bundle.key in current else "other episodes"
    return ListedIntervention(
        key=bundle.key,
        state=state,
        created=created,
        kind=str(settings["kind"]),
        categories=tuple(map(str, settings["categories"])),
        items=settings.get("items"),
        wording=str(settings.get("wording") or ""),
        parameters={name: value for name, value in settings.items() if name not in COMMON},
    )


def _plain(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def readers_of_results(run: Run) -> Iterator[Callable[[], object]]:
    """A function per stored intervention, which reads all of it. Raises RunDamagedError where one is none.

    Those of episodes that the run has no more are listed alone, as reading does.
    """
    read_interventions(run.location)
    for wording in run.wordings or (None,):
        reader = run if wording is None else run.in_wording(wording)
        for stored in stored_interventions(reader):
            yield partial(_read, reader, stored)


def _read(run: Run, stored: StoredIntervention) -> object:
    return effects_of(run, stored).to_json()
