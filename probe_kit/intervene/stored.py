"""Stored interventions of a run, `RUN/interventions/<key>/`, and the choice among them.

settings.json      the head: what was asked, of which commits, and the hashes of the rest; written last
episodes.npz       per condition and episode where the action would go, and how far it changed; per condition its
                   cell in columns: place, role, direction, coefficient, part
effects.csv        the same in numbers per category, for people and other programs
attention.npz      of the kind `attention`: shares per inference, block, iteration, head and role
attention_patches.npz  of it, where the family says which token sees what: shares per inference, block and patch
certificate.json   what was loaded, and what was checked

A stored intervention is chosen by its subject, never by the time at which it was made: another map, role,
direction, coefficient, or a try on fewer episodes replaces nothing. Conditions that were played on the same
episodes are pooled, whichever intervention they came with. No model is needed.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import hypot
from typing import Any, Self

import numpy as np

from probe_kit._system.bounded_files import UNREADABLE, parse_json
from probe_kit._system.escaping import as_argument
from probe_kit.errors import NoInterventionsError, RunDamagedError
from probe_kit.intervene.edited_cells import COLUMNS, NO_CELL, EditedCell, columns_of
from probe_kit.intervene.outcomes import (
    BY_CONDITION,
    CLEAN,
    IMAGE_SWAP,
    UNCHANGED,
    ConditionOutcomes,
    Effect,
    arrays_from_bytes,
)
from probe_kit.intervene.settings import FIRST_CHUNK, FORMAT, PER_STEP, key_of
from probe_kit.runs.layout import INTERVENTIONS
from probe_kit.runs.reader import RunReader, full_name
from probe_kit.runs.results import (
    Bundle,
    advice_for,
    axes_problem,
    complete_key,
    fields_problem,
    find_bundle,
    is_complete,
    read_bundles,
)
from probe_kit.runs.store import Location

EPISODES, EFFECTS, CERTIFICATE = "episodes.npz", "effects.csv", "certificate.json"
# As in Act2Answer's scene; `env.SceneSpec` has the positions.
TILES_APART = 0.31
"""Metres between the tiles of the default scene; also used for a run that stores no scene."""


@dataclass(frozen=True)
class Measurement:
    """One intervention of a run, stored or not yet: the source of effects, their table and their sentences.

    Attributes:
        settings: Settings that decided its numbers, see `settings_of`.
        read: Function that reads a stored file by its name; it raises RunDamagedError if the file was changed.
        files: Names of the stored files.
        key: Key, the name of its folder.
        created: ISO time (UTC); empty before it is stored.
    """

    run: RunReader = field(repr=False)
    settings: Mapping[str, Any]
    read: Callable[[str], bytes] = field(repr=False)
    files: Collection[str] = ()
    key: str = ""
    created: str = ""

    @classmethod
    def of(cls, run: RunReader, bundle: Bundle) -> Self:
        """Return the measurement of a stored bundle."""
        settings, created = bundle.head["settings"], bundle.times.get("created", "")
        return cls(run, settings, bundle.read, bundle.files, bundle.key, created)

    @property
    def kind(self) -> str:
        """The kind of the intervention."""
        return str(self.settings["kind"])

    @property
    def readout(self) -> str:
        """The readout, `first-chunk` or `per-step`."""
        return str(self.settings.get("readout", FIRST_CHUNK))

    @property
    def newest(self) -> tuple[str, str]:
        """The time at which it was made, and the key, which decide between equals."""
        return self.created, self.key

    @cached_property
    def outcomes(self) -> ConditionOutcomes:
        """The numbers of its conditions.

        Raises:
            RunDamagedError: If they were changed, or have the names of another version of probe_kit.
        """
        stored = self.arrays(EPISODES, ConditionOutcomes, ConditionOutcomes.AXES)
        if (first := str(stored["conditions"][:1])) != f"[{CLEAN!r}]":
            raise self._damage_error(EPISODES, f"has {first} as its first condition; expected {CLEAN!r}")
        # Runs of version 0.2 have none of these columns.
        if (lost := [name for name in COLUMNS if name not in stored]) and len(lost) < len(COLUMNS):
            raise self._damage_error(
                EPISODES, f"lacks {', '.join(lost)} beside the other columns of its conditions"
            )
        return ConditionOutcomes(**stored, seed_text=self.run.seed_text)

    def arrays(self, name: str, record: type, axes: Mapping[str, str]) -> dict[str, Any]:
        """Return the arrays of a stored file, which are fields of a dataclass.

        Args:
            name: The file.
            record: The dataclass.
            axes: The types and axes of the arrays, see `axes_problem`.

        Raises:
            RunDamagedError: For a file that is none of arrays, and for other names, types or shapes.
        """
        content = self.read(name)
        try:
            stored = arrays_from_bytes(content)
        except UNREADABLE as error:
            raise self._damage_error(name, f"cannot be read: {error}") from error
        if problem := fields_problem(record, stored):
            raise self._damage_error(name, f"{problem}: another version of probe_kit made it")
        if problem := axes_problem(axes, stored):
            raise self._damage_error(name, problem)
        return stored

    def _damage_error(self, name: str, problem: str) -> RunDamagedError:
        """Return the error about one file."""
        folder = f"{INTERVENTIONS}/{self.key}"
        return RunDamagedError(f"{self.run.location}/{folder}/{name} {problem}. {advice_for(folder)}")

    @cached_property
    def certificate(self) -> dict[str, Any]:
        """The record of what was loaded and checked.

        Raises:
            RunDamagedError: If it was changed.
        """
        certificate: dict[str, Any] = parse_json(self.read(CERTIFICATE))
        return certificate

    def rows[Row: Effect](self, of_category: Callable[[ConditionOutcomes], Iterable[Row]]) -> list[Row]:
        """Return the rows of all categories, in the order of the episodes, each with the key."""
        parts = (of_category(part) for _, part in self.outcomes.by_category())
        key: dict[str, Any] = {"key": self.key}  # every kind's rows have it, as their last column
        return [replace(row, **key) for rows in parts for row in rows]

    # -- words of tables -----------------------------------------------------------------------------------------

    @property
    def subject(self) -> str:
        """The model and suite, as in titles."""
        label = full_name(self.run.label, self.run.random_weights)
        # The label of a run of recordings says on what already.
        name = self.run.suite.partition("#")[0]
        return label if self.run.label.endswith(f" on {name}") else f"{label} on {self.run.suite}"

    @property
    def is_scene(self) -> bool:
        """Whether the run is of the scene, where the correct picture lies on a side."""
        return self.outcomes.is_scene

    @property
    def exchange(self) -> str:
        """The change of inputs of which effects are shares, in words."""
        return "image swap" if self.is_scene else f"exchange of the {self.settings.get('vary') or ''}"

    @property
    def verdicts(self) -> Mapping[str, Any]:
        """The `UseVerdict` by category: those of an `InterventionResult`, here none."""
        return {}

    @property
    def legend(self) -> str:
        """The explanation of the verdicts that a reader must know."""
        return ""

    @property
    def tiles_apart(self) -> float:
        """The metres between the middles of the tiles of the run's scene, or of the default one."""
        scene: Any = self.run.settings.get("scene", {})
        if "tile_left" not in scene or "tile_right" not in scene:
            return TILES_APART
        (left_x, left_y), (right_x, right_y) = scene["tile_left"], scene["tile_right"]
        return hypot(left_x - right_x, left_y - right_y)


def is_stored(run: Location, key: str) -> bool:
    """Whether the run has complete results with this key."""
    return is_complete(run, INTERVENTIONS, key)


def read_interventions(run: Location) -> dict[str, Bundle]:
    """Return every complete intervention by key.

    Raises:
        RunDamagedError: If one was changed or has another format.
    """
    bundles = read_bundles(run, INTERVENTIONS)
    for bundle in bundles.values():
        _check_bundle(bundle)
    return bundles


def find_measurement(run: RunReader, key: str) -> Measurement | None:
    """Return the complete intervention with this key; None if there is none. No other one is read.

    Raises:
        RunDamagedError: If it was changed or has another format.
    """
    if (bundle := find_bundle(run.location, INTERVENTIONS, key)) is None:
        return None
    _check_bundle(bundle)
    return Measurement.of(run, bundle)


def _check_bundle(bundle: Bundle) -> None:
    """Raise RunDamagedError for an intervention of another format, or with the settings of another one."""
    bundle.check_format(FORMAT)
    if (key_of_settings := key_of(bundle.head["settings"])) != bundle.key:
        raise bundle.head_damaged(f"has the settings of {key_of_settings}")


def stored_interventions(run: RunReader, kind: str | None = None) -> list[Measurement]:
    """Return the interventions on the episodes that the run has now, in its wording, oldest first.

    Args:
        run: Run with the stored interventions.
        kind: Only those of this kind; None for all.

    Raises:
        RunDamagedError: If any of the run was changed, lost its settings or has another format.
    """
    required = {"stamp": run.stamp, "run_settings": run.settings_sha256, "wording": run.wording}
    if kind is not None:
        required["kind"] = kind
    fitting = [
        Measurement.of(run, bundle)
        for bundle in read_interventions(run.location).values()
        if all(bundle.head["settings"].get(name) == value for name, value in required.items())
    ]
    return sorted(fitting, key=lambda intervention: intervention.newest)


def find_stored(run: RunReader, key: str | None = None, kind: str | None = None) -> Measurement:
    """Return the stored intervention whose key begins with `key`, or the newest of `kind`.

    Raises:
        NoInterventionsError: If there is none.
        UsageError: For a key that does not exist or is not the only one.
    """
    candidates = stored_interventions(run, kind)
    if key is None:
        if not candidates:
            raise NoInterventionsError(
                f"{run.location} has no stored intervention{'' if kind is None else f' of kind {kind}'} on its "
                f"episodes. Run `probe-kit intervene {as_argument(run.location)}`"
            )
        return candidates[-1]
    by_key = {intervention.key: intervention for intervention in candidates}
    return by_key[complete_key(key, by_key, run.location, "interventions")]


# -- the choice among stored ones ----------------------------------------------------------------------------


Rank = tuple[bool, int, bool]
"""The rank of a result: the larger, the more it tells.

It compares whether the readout is right, the number of episodes, and whether the readout is the one that its
family prefers. The readout is wrong for the first inference of a family in which that carries little information
(`per-step`).
"""


@dataclass(frozen=True)
class StoredResult:
    """The part of one stored intervention that is of one category.

    Attributes:
        outcomes: Outcomes of the category's episodes alone.
    """

    stored: Measurement
    category: str
    outcomes: ConditionOutcomes
    rank: Rank


def stored_results(run: RunReader, kind: str) -> list[StoredResult]:
    """Return results by category in the order of the run, with the one that tells most last in each.

    Of equal ones, the newest is last.

    Raises:
        RunDamagedError: If a stored intervention was changed.
    """
    order = {name: at for at, name in enumerate(dict.fromkeys(run.episodes["category"].astype(str)))}
    results = []
    for stored in stored_interventions(run, kind):
        family = stored.certificate.get("supported", {}).get("readout", FIRST_CHUNK)
        # Where one inference is one action in greedy bins, the first says little: any other readout says more.
        is_wrong = family == PER_STEP != stored.readout
        for category, outcomes in stored.outcomes.by_category():
            rank = not is_wrong, outcomes.episodes.size, stored.readout == family
            results.append(StoredResult(stored, category, outcomes, rank))
    return sorted(
        results,
        key=lambda result: (
            order.get(result.category, len(order)), result.category, result.rank, result.stored.newest,
        ),
    )  # fmt: skip


def preferred_by_category(run: RunReader, kind: str, readout: str | None = None) -> dict[str, StoredResult]:
    """Return by category the stored result of a kind that tells most.

    Args:
        run: Run with the stored interventions.
        kind: Name of the kind.
        readout: Readout of the results, `first-chunk` or `per-step`; None for any.

    Raises:
        RunDamagedError: If a stored intervention was changed.
    """
    results = stored_results(run, kind)
    return {result.category: result for result in results if readout in (None, result.stored.readout)}


@dataclass(frozen=True)
class PooledConditions:
    """Conditions that several interventions played on the same episodes of one category.

    Attributes:
        like: One of the results.
        sources: By condition, the result it is from; without conditions in which nothing was changed.
        cells: The cell that each of these conditions edits.
    """

    like: StoredResult
    sources: dict[str, StoredResult]
    cells: dict[str, EditedCell]

    def outcomes(self, conditions: Sequence[str]) -> ConditionOutcomes:
        """Return some of the conditions, in the requested order, behind the unchanged ones."""
        base = self.like.outcomes
        unchanged = [name for name in (CLEAN, IMAGE_SWAP) if name in base.conditions]
        every = [(base, name) for name in unchanged] + [(self.sources[name].outcomes, name) for name in conditions]
        stacked: dict[str, Any] = {}
        for array in BY_CONDITION:
            values = [getattr(outcomes, array) for outcomes, _ in every]
            rows = (outcomes.conditions.index(name) for outcomes, name in every)
            has_all = all(value is not None for value in values)  # an older one may be stored without it
            stacked[array] = (
                np.stack([value[row] for value, row in zip(values, rows, strict=True)]) if has_all else None
            )
        cells = [self.cells.get(name, NO_CELL) for _, name in every]
        return replace(base, conditions=tuple(name for _, name in every), **columns_of(cells), **stacked)


def pool_conditions(results: Iterable[StoredResult], setting: Sequence[str] = ()) -> list[PooledConditions]:
    """Pool conditions that were played on the same episodes, with the same actions where nothing was changed.

    Args:
        results: Results in the order of `stored_results`.
        setting: Names of settings in which they must agree as well.
    """
    pooled: dict[tuple[object, ...], PooledConditions] = {}
    for result in results:
        outcomes = result.outcomes
        agreed = tuple(str(result.stored.settings.get(name)) for name in ("readout", *setting))
        # Bytes, not closeness: another device or batch rounds otherwise, and effects are differences of actions.
        unchanged = [outcomes.of(name).tobytes() for name in (CLEAN, IMAGE_SWAP) if name in outcomes.conditions]
        same = (result.category, *agreed, tuple(outcomes.episodes.tolist()), *unchanged)
        together = pooled.setdefault(same, PooledConditions(result, {}, {}))
        for name, cell in zip(outcomes.conditions, outcomes.cells, strict=True):
            if name not in UNCHANGED:
                together.sources[name], together.cells[name] = result, cell
    return list(pooled.values())
