"""What batches are made of: two pictures somewhere, and which of them is asked for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlm_tiny_training.painting import Surface
from vlm_tiny_training.pictures import PictureBank

Pixels = NDArray[np.float32]


@dataclass(frozen=True)
class Pair:
    """Two pictures and what they are called; of each, the asked one comes first.

    Attributes:
        bank: Of the category.
        pictures: Couple and member.
        phrases: Of the two.
    """

    bank: PictureBank
    pictures: tuple[tuple[int, int], tuple[int, int]]
    phrases: tuple[str, str]


class Pairs:
    """Draws pairs: a category, two of its concepts that may meet, and a picture of each, from any couples."""

    def __init__(self, banks: Sequence[PictureBank], shares: Mapping[str, float]) -> None:
        self._banks = [bank for bank in banks if bank.category in shares]
        weights = np.array([shares[bank.category] for bank in self._banks])
        self._shares = weights / weights.sum()
        self._pairs = [bank.by_pair() for bank in self._banks]

    def draw(self, rng: np.random.Generator) -> Pair:
        """One of them."""
        kind = int(rng.choice(len(self._banks), p=self._shares))
        bank, pair = self._banks[kind], self._pairs[kind][rng.integers(len(self._pairs[kind]))]
        asked_index = int(rng.integers(2))
        drawn = []
        for wanted_index in (asked_index, 1 - asked_index):
            couple, turned = pair[rng.integers(len(pair))]
            drawn.append((int(couple), int(wanted_index ^ turned)))
        target, other = drawn
        return Pair(bank, (target, other), (str(bank.phrases[target]), str(bank.phrases[other])))

    def phrases(self) -> list[str]:
        """What pictures are called, each once."""
        return sorted({str(phrase) for bank in self._banks for phrase in bank.phrases.ravel()})

    def absent(self, pair: Pair, rng: np.random.Generator) -> str:
        """A phrase of the category that names neither picture."""
        while True:
            phrase = str(rng.choice(pair.bank.phrases.ravel()))
            if phrase not in pair.phrases:
                return phrase


def laid_out(name: str, surface: Surface, pair: Pair, side: int) -> Pixels:
    """(96, 96, 3) float32 in [0, 255]: the asked picture of a pair on `side` (0 left), the other one opposite."""
    picture = surface.background.copy()
    for where, (couple, member) in zip((side, 1 - side), pair.pictures, strict=True):
        area = surface.places[where]
        picture[area.rows, area.columns] += pair.bank.painted[name][where][couple, member]
    return picture.clip(0, 255)
