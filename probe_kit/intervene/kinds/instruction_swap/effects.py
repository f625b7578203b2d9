"""What a swap of the instruction did, and how much one step's action owes to instruction, images and noise.

Reads stored outcomes; needs no model.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from probe_kit.intervene.kinds.base import Measurement
from probe_kit.intervene.kinds.image_swap.effects import ImageSwapEffect, swap_columns
from probe_kit.intervene.kinds.reach import Reach
from probe_kit.intervene.store.answers import CLEAN, IMAGE_SWAP, INSTRUCTION_SWAP, NOISE, ConditionOutcomes

_CONDITIONS = {"instruction": INSTRUCTION_SWAP, "images": IMAGE_SWAP, "noise": NOISE}


@dataclass(frozen=True)
class InputSensitivity:
    """Of the first inferences of one category; one input is swapped, the others stay.

    instruction, images, noise: median lateral metres between where the two actions would bring the hand.
    instruction_changed, images_changed: share of episodes in which any number of the action changed at all; 0
    means that the policy ignores that input.
    """

    instruction: float
    images: float
    noise: float
    instruction_changed: float
    images_changed: float


@dataclass(frozen=True, kw_only=True)
class InstructionSwapEffect(ImageSwapEffect):
    """As `ImageSwapEffect`, of the swapped instruction. sensitivity: of one step to each input."""

    sensitivity: InputSensitivity

    def to_json(self) -> dict[str, Any]:
        """Plain values, the sensitivity's among them."""
        plain = super().to_json()
        return {**{name: value for name, value in plain.items() if name != "sensitivity"}, **plain["sensitivity"]}


def instruction_swap_effects(measurement: Measurement) -> list[InstructionSwapEffect]:
    """One per category, in the order of the episodes."""
    reach = Reach.of(measurement.outcomes.of(CLEAN), measurement.tiles_apart)
    return [
        InstructionSwapEffect(
            **swap_columns(own, category, INSTRUCTION_SWAP, measurement.seed_text, reach),
            readout=measurement.readout,
            key=measurement.key,
            sensitivity=input_sensitivity(own),
        )
        for category, own in measurement.outcomes.by_category()
    ]


def input_sensitivity(outcomes: ConditionOutcomes) -> InputSensitivity:
    """Of the episodes of one category."""
    clean = outcomes.of(CLEAN)
    apart = {name: float(np.median(np.abs(outcomes.of(own) - clean))) for name, own in _CONDITIONS.items()}
    changed = {
        f"{name}_changed": float(
            (outcomes.max_action_change[outcomes.conditions.index(_CONDITIONS[name])] > 0).mean()
        )
        for name in ("instruction", "images")
    }
    return InputSensitivity(**apart, **changed)
