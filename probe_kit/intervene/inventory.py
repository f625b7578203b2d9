"""The list of a run's stored interventions, and which of them tables and figures read; loads no model."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from probe_kit._system.counting import plural
from probe_kit.intervene.kinds import kind_names, kind_of
from probe_kit.intervene.results import InterventionResult
from probe_kit.intervene.stored import read_interventions, stored_interventions
from probe_kit.runs.reader import RunReader
from probe_kit.runs.run import Run

COMMON = frozenset(
    {"format", "kind", "run_settings", "stamp", "weights", "wording", "categories", "items", "readout", "donors"}
)
"""Names of the settings of every intervention; its other settings are its kind's own."""


@dataclass(frozen=True)
class ListedIntervention:
    """One stored intervention.

    Attributes:
        state: Use of the result. It is `used` by verdicts, tables and figures, or of a kind that none of them
            reads. It is `other` if other results contain all of it, of more episodes or newly. It is `other
            episodes` if the run has different ones by now.
        created: ISO time (UTC).
        items: Number of items of each category; None for all.
        wording: Name of the wording; empty for the items' own words.
        parameters: Settings of its kind alone, as stored.
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
        """A line about the intervention."""
        parts = [f"{self.kind} of {', '.join(self.categories)}"]
        parts += [] if self.items is None else [f"{plural(self.items, 'item')} each"]
        parts += [f"wording {self.wording}"] * bool(self.wording)
        for name, value in self.parameters.items():
            if value not in (None, []):
                parts.append(f"{name} {', '.join(map(str, value)) if isinstance(value, list) else value}")
        parts += ["another one stands in its place in tables"] * (self.state == "other")
        parts += ["of other episodes than the run has now"] * (self.state == "other episodes")
        return "; ".join([*parts, f"made {self.created[:16].replace('T', ' ')} UTC"])


def listed_interventions(run: Any) -> list[ListedIntervention]:
    """Return all interventions of a run, oldest first.

    Raises:
        RunDamagedError: If one was changed.
    """
    readers: list[RunReader] = [run.in_wording(name) for name in run.wordings] or [run]
    current: set[str] = set()
    used: set[str] = set()
    for reader in readers:
        by_kind: dict[str, set[str]] = {}
        for stored in stored_interventions(reader):
            by_kind.setdefault(str(stored.settings["kind"]), set()).add(stored.key)
        for name, keys in by_kind.items():
            # A kind of another package may be missing here; all of its results then count as used.
            # Keys of what is read, and of the kinds of which nothing takes another's place.
            preferred = kind_of(name).keys_in_use(reader) if name in kind_names() else None
            used |= keys if preferred is None else preferred
            current |= keys
    listed = []
    for key, bundle in read_interventions(run.location).items():
        settings = bundle.head["settings"]
        intervention = ListedIntervention(
            key=key,
            state="used" if key in used else "other" if key in current else "other episodes",
            created=bundle.times.get("created", ""),
            kind=str(settings["kind"]),
            categories=tuple(map(str, settings["categories"])),
            items=settings.get("items"),
            wording=str(settings.get("wording") or ""),
            parameters={name: value for name, value in settings.items() if name not in COMMON},
        )
        listed.append(intervention)
    return sorted(listed, key=lambda intervention: (intervention.created, intervention.key))


def readers_of_results(run: Run) -> Iterator[Callable[[], object]]:
    """Yield a function per stored intervention, which reads all of it.

    Those of episodes that the run no longer has are only listed, which finds changed ones too.

    Raises:
        RunDamagedError: If a stored intervention was changed.
    """
    read_interventions(run.location)
    for wording in run.wordings or (None,):
        reader = run if wording is None else run.in_wording(wording)
        for stored in stored_interventions(reader):
            yield InterventionResult.of_stored(stored).to_json
