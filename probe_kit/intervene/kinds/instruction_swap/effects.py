"""How much one step's action owes to words, to pictures and to noise. Reads stored answers; needs no model."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from probe_kit.intervene.store.answers import CLEAN, IMAGE_SWAP, NOISE, PICTURES, ConditionOutcomes

_CONDITIONS = {"words": IMAGE_SWAP, "pictures": PICTURES, "noise": NOISE}


@dataclass(frozen=True)
class InputSensitivity:
    """Of the first inferences of one category; one is exchanged, the others stay.

    words, pictures, noise: median metres between where the two actions would bring the hand, across.
    words_changed, pictures_changed: share of episodes in which any number of the action changed at all; 0 is a
    policy that is deaf or blind.
    """

    category: str
    n_episodes: int
    words: float
    pictures: float
    noise: float
    words_changed: float
    pictures_changed: float

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def input_sensitivity(outcomes: ConditionOutcomes) -> list[InputSensitivity]:
    """One per category, in the order of the episodes; empty where words were not exchanged."""
    if not {PICTURES, NOISE} <= set(outcomes.conditions):
        return []
    return [_of_category(own, category) for category, own in outcomes.by_category()]


def _of_category(outcomes: ConditionOutcomes, category: str) -> InputSensitivity:
    plain = outcomes.of(CLEAN)
    apart = {name: float(np.median(np.abs(outcomes.of(own) - plain))) for name, own in _CONDITIONS.items()}
    changed = {
        f"{name}_changed": float(
            (outcomes.max_action_change[outcomes.conditions.index(_CONDITIONS[name])] > 0).mean()
        )
        for name in ("words", "pictures")
    }
    return InputSensitivity(category, plain.size, **apart, **changed)
