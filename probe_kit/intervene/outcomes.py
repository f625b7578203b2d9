"""The store of interventions: `RUN/interventions/<key>/`, complete or not there. Reading needs no model.

settings.json      the head: what was asked, of which commits, and the hashes of the rest; written last
episodes.npz       per condition and episode where the action would go, and how far it changed
effects.csv        the same in numbers per category, for people and other programs
attention.npz      of the kind `attention`: shares per inference, block, iteration, head and role
attention_patches.npz  of it, where the family says which token sees what: shares per inference, block and patch
certificate.json   what was loaded, and what was checked
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from io import BytesIO
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.bounded_files import open_arrays
from probe_kit.errors import NoInterventionsError
from probe_kit.intervene.settings import FORMAT, key_of
from probe_kit.runs.layout import INTERVENTIONS
from probe_kit.runs.reader import RunReader
from probe_kit.runs.records import as_json
from probe_kit.runs.results import (
    HEAD,
    Bundle,
    complete_key,
    read_bundles,
    tidy_bundle,
    write_bundle,
)
from probe_kit.runs.store import Location

CLEAN, IMAGE_SWAP, INSTRUCTION_SWAP, NOISE = "clean", "image_swap", "instruction_swap", "noise"
"""Conditions: as in the run, the two pictures swapped, the counterpart's instruction, the noise drawn anew."""
ERASE, PROBE_ACCURACY = "erase", "probe_accuracy"
"""A kind, and what its certificate calls what probes read behind its conditions."""
ATTENTION, RECORDED, ATTENTION_FILE = "attention", "recorded", "attention.npz"
"""A kind, its condition with recorded weights, and the file in which they are."""
PATCHES_FILE = "attention_patches.npz"
"""The attention on single patches of the first camera's picture, and where they lie in it."""
DONOR, CONTROL_INPUT = "frame_swap", "control_input"
"""Conditions without sides: all inputs of the donor, and a change of the input that means nothing."""
UNCHANGED = frozenset({CLEAN, IMAGE_SWAP, INSTRUCTION_SWAP, NOISE, RECORDED, DONOR, CONTROL_INPUT})
"""Conditions in which nothing inside the network is changed."""
EPISODES, EFFECTS, CERTIFICATE = "episodes.npz", "effects.csv", "certificate.json"


BY_CONDITION = ("displacement", "max_action_change", "edit_log", "episode_outcomes", "toward", "size")
"""Arrays with conditions along their first axis."""


@dataclass(frozen=True)
class ConditionOutcomes:
    """The numbers of K conditions in E episodes of a run; see `replay.ReplayBatch`.

    conditions: names of the K, the clean one first. episodes, items, groups, categories, sides: (E,), `sides`
    those of the correct picture. displacement: (K, E) metres from the middle, left positive. max_action_change:
    (K, E) largest difference of any action from the clean one's. edit_log: (K, E, 5), see `LOG_FIELDS`.
    replay_error: (E,) of the clean one from the stored one. toward, size: (K, E) displacement toward the source's
    action and size of the change, in spreads of clean actions; None where whole episodes were played.
    episode_outcomes: (K, E) correct, wrong or oob, where episodes were played to their end; else None.
    """

    conditions: tuple[str, ...]
    episodes: NDArray[np.str_]
    items: NDArray[np.str_]
    groups: NDArray[np.str_]
    categories: NDArray[np.str_]
    sides: NDArray[np.str_]
    displacement: NDArray[np.float64]
    max_action_change: NDArray[np.float64]
    edit_log: NDArray[np.float64]
    replay_error: NDArray[np.float64]
    episode_outcomes: NDArray[np.str_] | None = None
    toward: NDArray[np.float64] | None = None
    size: NDArray[np.float64] | None = None

    @property
    def has_sides(self) -> bool:
        """Whether the correct picture lies on a side; else displacements are toward the source's action."""
        return bool(self.sides.size) and bool(self.sides[0])

    def of(self, condition: str) -> NDArray[np.float64]:
        """(E,) lateral of one condition."""
        return np.asarray(self.displacement[self.conditions.index(condition)])

    @property
    def correct_sign(self) -> NDArray[np.float64]:
        """(E,) +1 where the correct picture lies left, −1 where it lies right, or where nothing has a side."""
        return np.where(self.sides == "left", 1.0, -1.0)

    def only(self, category: str) -> "ConditionOutcomes":
        """The episodes of one category."""
        return self.of_episodes(self.categories == category)

    def of_episodes(self, selected: NDArray[np.bool_]) -> "ConditionOutcomes":
        """Some of the episodes. selected: (E,)."""
        axes = dict.fromkeys(BY_CONDITION, 1)
        cut: dict[str, Any] = {
            name: np.compress(selected, value, axes.get(name, 0))
            for name, value in vars(self).items()
            if name != "conditions" and value is not None
        }
        return ConditionOutcomes(self.conditions, **cut)

    def by_category(self) -> "list[tuple[str, ConditionOutcomes]]":
        """Every category with its episodes, in the order of the episodes."""
        return [(name, self.only(name)) for name in dict.fromkeys(map(str, self.categories))]

    def to_bytes(self) -> bytes:
        """Return a `.npz`; the same numbers give the same bytes."""
        file = BytesIO()
        arrays = {name: value for name, value in vars(self).items() if value is not None}
        arrays["conditions"] = np.array(self.conditions)
        np.savez_compressed(file, allow_pickle=False, **arrays)
        return file.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> "ConditionOutcomes":
        """Load what `to_bytes` gave."""
        with open_arrays(content) as arrays:
            values: dict[str, Any] = dict(arrays)
        return cls(**{**values, "conditions": tuple(map(str, values["conditions"]))})


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One row of effects, read from outcomes; every kind adds columns."""

    category: str

    def to_json(self) -> dict[str, Any]:
        """Return plain values by column."""
        return asdict(self)


@dataclass(frozen=True)
class StoredIntervention:
    """One stored intervention. settings: see `settings.settings_of`. created: when it was made."""

    bundle: Bundle

    @property
    def key(self) -> str:
        """Name of its folder."""
        return self.bundle.key

    @property
    def settings(self) -> Mapping[str, Any]:
        """Return what decided its numbers."""
        settings: Mapping[str, Any] = self.bundle.head["settings"]
        return settings

    @property
    def created(self) -> str:
        """ISO time, UTC."""
        return self.bundle.times.get("created", "")

    def outcomes(self) -> ConditionOutcomes:
        """Read what was measured. Raises RunDamagedError if it was changed."""
        return ConditionOutcomes.from_bytes(self.bundle.read(EPISODES))

    def certificate(self) -> dict[str, Any]:
        """Read what was loaded and checked. Raises RunDamagedError if it was changed."""
        return self.bundle.read_json(CERTIFICATE)


def save(
    run: Location,
    settings: Mapping[str, Any],
    key: str,
    outcomes: ConditionOutcomes,
    effects: str,
    certificate: Mapping[str, Any],
    extra_files: Mapping[str, bytes] = MappingProxyType({}),
) -> None:
    """Write `interventions/<key>/`, all or nothing; what is there is kept. extra_files: by name."""
    if is_stored(run, key):
        tidy_bundle(run, INTERVENTIONS, key)
        return
    files = {
        EPISODES: outcomes.to_bytes(), EFFECTS: effects.encode(), CERTIFICATE: as_json(certificate), **extra_files,
    }  # fmt: skip
    now = datetime.now(UTC).isoformat(timespec="microseconds")
    write_bundle(run, INTERVENTIONS, key, {"settings": dict(settings)}, files, {"created": now})


def is_stored(run: Location, key: str) -> bool:
    """Whether complete results called `key` are there."""
    return run.exists(f"{INTERVENTIONS}/{key}/{HEAD}")


def read_interventions(run: Location) -> dict[str, Bundle]:
    """Every complete intervention by key. Raises RunDamagedError if one was changed or has another format."""
    bundles = read_bundles(run, INTERVENTIONS)
    for key, bundle in bundles.items():
        bundle.check_format(FORMAT)
        if (key_of_settings := key_of(bundle.head["settings"])) != key:
            raise bundle.head_damaged(f"has the settings of {key_of_settings}")
    return bundles


def stored_interventions(run: RunReader, kind: str | None = None) -> list[StoredIntervention]:
    """Return those of the episodes that the run has now, in the wording it is in, oldest first.

    kind: only these. Raises RunDamagedError if any of the run was changed, lost its settings or has another
    format.
    """
    interventions = [StoredIntervention(bundle) for bundle in read_interventions(run.location).values()]
    required = {
        "stamp": run.stamp, "run_settings": run.settings_sha256,
        "wording": run.wording, **({} if kind is None else {"kind": kind}),
    }  # fmt: skip
    fitting = [
        intervention
        for intervention in interventions
        if all(intervention.settings.get(name) == value for name, value in required.items())
    ]
    return sorted(fitting, key=lambda intervention: (intervention.created, intervention.key))


def find_stored(run: RunReader, key: str | None = None, kind: str | None = None) -> StoredIntervention:
    """The one whose key begins with `key`, or the newest of `kind`.

    Raises NoInterventionsError if there is none, UsageError for a key that is not there or not the only one.
    """
    candidates = stored_interventions(run, kind)
    if key is None:
        if not candidates:
            raise NoInterventionsError(
                f"{run.location} has no stored intervention{'' if kind is None else f' of kind {kind}'} on its "
                f"episodes. Run `probe-kit intervene {run.location}`"
            )
        return candidates[-1]
    by_key = {intervention.key: intervention for intervention in candidates}
    return by_key[complete_key(key, by_key, run.location, "interventions")]
