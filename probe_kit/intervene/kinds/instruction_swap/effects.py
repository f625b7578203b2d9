"""How much one step's action owes to words, to pictures and to noise. Reads stored answers; needs no model."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from probe_kit.intervene.store.answers import EXCHANGED, NOISE, PICTURES, PLAIN, Answers

_CONDITIONS = {"words": EXCHANGED, "pictures": PICTURES, "noise": NOISE}


@dataclass(frozen=True)
class Sensitivity:
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


def sensitivity(answers: Answers) -> list[Sensitivity]:
    """One per category, in the order of the episodes; empty where words were not exchanged."""
    if not {PICTURES, NOISE} <= set(answers.conditions):
        return []
    return [_of_category(own, category) for category, own in answers.by_category()]


def _of_category(answers: Answers, category: str) -> Sensitivity:
    plain = answers.of(PLAIN)
    apart = {name: float(np.median(np.abs(answers.of(own) - plain))) for name, own in _CONDITIONS.items()}
    changed = {
        f"{name}_changed": float((answers.changed[answers.conditions.index(_CONDITIONS[name])] > 0).mean())
        for name in ("words", "pictures")
    }
    return Sensitivity(category, plain.size, **apart, **changed)
