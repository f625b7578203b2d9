"""Answers made by hand: where the action goes, per episode of items in two layouts."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.intervene import ConditionOutcomes, InterventionResult, UseVerdict
from probe_kit.intervene.edited_cells import NO_CELL, EditedCell, columns_of
from probe_kit.intervene.kinds.image_swap import ImageSwapEffect, image_swap_effects
from probe_kit.intervene.kinds.interchange import PatchEffect, patch_effects
from probe_kit.intervene.kinds.knockout import windows
from probe_kit.intervene.outcomes import IMAGE_SWAP
from probe_kit.intervene.results import save
from probe_kit.intervene.settings import FIRST_CHUNK
from probe_kit.intervene.stored import CERTIFICATE, EPISODES, Measurement
from probe_kit.runs import Location
from probe_kit.runs.records import as_json

Cell = NDArray[np.float64]
KNOCKOUT_LAYERS, KNOCKOUT_EPISODES = 6, 48
"""Layers that can be cut, and episodes, of `knockout_of`."""


def outcomes_of(signs: Mapping[str, tuple[Cell, Cell]], groups: int | None = None) -> ConditionOutcomes:
    """signs: by category, metres toward the correct side (E,), plain and exchanged; two layouts an item."""
    rows: dict[str, list[str]] = {name: [] for name in ("episodes", "items", "groups", "categories", "sides")}
    displacement: list[list[float]] = [[], []]
    for category, (plain, exchanged) in signs.items():
        for number, values in enumerate(zip(plain, exchanged, strict=True)):
            item, swapped = divmod(number, 2)
            side = ("left", "right")[(item + swapped) % 2]
            rows["episodes"].append(f"{category}-{item}:{'os'[swapped]}")
            rows["items"].append(f"{category}-{item}")
            rows["groups"].append(f"{category}-{item if groups is None else item % groups}")
            rows["categories"].append(category)
            rows["sides"].append(side)
            for row, value in zip(displacement, values, strict=True):
                row.append(value if side == "left" else -value)
    moved = np.array(displacement)
    return ConditionOutcomes(
        conditions=("clean", "image_swap"),
        **{name: np.array(values) for name, values in rows.items()},
        displacement=moved,
        max_action_change=np.abs(moved - moved[0]),
        edit_log=np.zeros((*moved.shape, 5)),
        replay_error=np.zeros(moved.shape[1]),
    )


def follower(episodes: int) -> tuple[Cell, Cell]:
    """Always goes to the correct picture, wherever it lies."""
    return np.full(episodes, 0.1), np.full(episodes, -0.1)


def habit(episodes: int) -> tuple[Cell, Cell]:
    """Always goes left, but for tiny shifts whose sign is drawn once per item."""
    draw = np.random.default_rng(1)
    displacements = np.where([(n // 2 + n % 2) % 2 == 0 for n in range(episodes)], 0.1, -0.1)
    nudge = np.repeat(draw.permutation([1e-5, -1e-5] * (episodes // 4)), 2)
    return displacements, displacements - nudge


def knockout_of(reads: dict[str, list[set[int]]], seed: int, window: str = "both") -> ConditionOutcomes:
    """A follower with the loss that its reading implies: a role is lost if all layers of one of its sets are cut.

    Actions of every condition have noise of their own, and a control loses nothing.
    """
    plain = outcomes_of({"color": follower(KNOCKOUT_EPISODES)})
    draw = np.random.default_rng(seed)
    names, rows = list(plain.conditions), [plain.displacement[0], plain.displacement[1]]
    cells = [NO_CELL] * 2
    for role, sets in reads.items():
        for first, last in windows(window, KNOCKOUT_LAYERS):
            cut = set(range(first, last + 1))
            is_lost = bool(sets) and all(needed & cut for needed in sets)
            for name in ("cut", "control-1", "control-2"):
                cells.append(EditedCell(f"expert.{first:02d}-{last:02d}.heads", role, name))
                names.append(str(cells[-1]))
                remaining = 0.1 if is_lost and name == "cut" else 1.0
                rows.append(remaining * plain.displacement[0])
    moved = np.array(rows)
    moved[2:] += draw.normal(0, 0.03, moved[2:].shape)
    change = np.abs(moved - moved[0])
    return replace(
        plain,
        conditions=tuple(names),
        **columns_of(cells),
        displacement=moved,
        max_action_change=change,
        size=change,
        edit_log=np.ones((*moved.shape, 5)),
    )


def store_outcomes(
    location: Location,
    seed_text: str,
    settings: Mapping[str, Any],
    outcomes: ConditionOutcomes,
    certificate: Mapping[str, Any] | None = None,
    extra_files: Mapping[str, bytes] | None = None,
) -> str:
    """Stored as if they had been measured, with the effects of their kind; gives the key."""
    check = {"replay": {"episodes": 0, "compared": 0, "equal": 0, "largest_difference": 0.0}}
    run = SimpleNamespace(location=location, seed_text=seed_text, settings={})
    return save(run, settings, outcomes, certificate or check, extra_files or {})  # type: ignore[arg-type]


def measured(
    outcomes: ConditionOutcomes,
    seed_text: str,
    settings: Mapping[str, Any] = MappingProxyType({}),
    certificate: Mapping[str, Any] = MappingProxyType({}),
    read: Callable[[str], bytes] = str.encode,
) -> Measurement:
    files = {EPISODES: outcomes.to_bytes(), CERTIFICATE: as_json(dict(certificate))}
    run = SimpleNamespace(label="wired", random_weights=False, suite="suite", settings={}, seed_text=seed_text)
    return Measurement(run, settings, lambda name: files.get(name) or read(name))  # type: ignore[arg-type]


def with_parts(
    result: InterventionResult,
    outcomes: ConditionOutcomes | None = None,
    certificate: Mapping[str, Any] | None = None,
) -> InterventionResult:
    """The same with other outcomes, or another certificate."""
    parts = result.settings, result.certificate if certificate is None else certificate, result.read
    changed = measured(outcomes or result.outcomes, result.run.seed_text, *parts)
    return replace(result, read=changed.read)


class Said(InterventionResult):
    """A result with verdicts made by hand."""

    verdicts: Mapping[str, UseVerdict] = {}  # type: ignore[assignment]


def said_of(measurement: Measurement, verdicts: Mapping[str, UseVerdict] = MappingProxyType({})) -> Said:
    result = Said.of_stored(measurement)
    assert isinstance(result, Said)
    result.__dict__["verdicts"] = verdicts
    return result


def swaps_of(outcomes: ConditionOutcomes, seed_text: str, readout: str = FIRST_CHUNK) -> list[ImageSwapEffect]:
    return image_swap_effects(measured(outcomes, seed_text, {"readout": readout}))


def patches_of(outcomes: ConditionOutcomes, seed_text: str, target_side: str = IMAGE_SWAP) -> list[PatchEffect]:
    return measured(outcomes, seed_text).rows(lambda part: patch_effects(part, target_side))
