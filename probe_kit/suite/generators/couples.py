"""Couples of tiles: the two concepts, which one is left, and their appearance."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from probe_kit.hashing import derive_seed
from probe_kit.suite.generators.generator import Concept, Generator, Tile

SUITE_NAME = "a2a-embedded"
# The next major version if the picture, text or side of any item changes; the next minor if items are added.
SUITE_VERSION = "2.0.0"


@dataclass(frozen=True)
class Couple:
    """Two tiles as they lie in the original layout; asked for once each, they become two items."""

    left: Concept
    right: Concept
    left_tile: Tile
    right_tile: Tile
    left_asked_first: bool


def draw_couples(generator: Generator[Any], seed: int) -> Iterator[Couple]:
    """Endless couples of one category; the first ones are the same however many are taken."""
    order = _random("order", generator.category, seed)
    for number, (left, right) in enumerate(visiting_order(generator.pairs, order)):
        rng = _random(number, generator.category, seed)
        left_asked_first = bool(rng.integers(2))
        left_tile, right_tile = generator.tiles(left, right, rng)
        yield Couple(left, right, left_tile, right_tile, left_asked_first)


def visiting_order[C: Concept](pairs: Sequence[tuple[C, C]], rng: np.random.Generator) -> Iterator[tuple[C, C]]:
    """Endless (left, right) pairs: all of them shuffled, then all of them shuffled again.

    The concept that has lain left more often goes right, so that no phrase leans to one side.
    """
    lean: Counter[str] = Counter()
    while True:
        for index in rng.permutation(len(pairs)):
            left, right = pairs[index]
            surplus = lean[left.phrase] - lean[right.phrase]
            if surplus > 0 or (surplus == 0 and rng.integers(2)):
                left, right = right, left
            lean.update({left.phrase: 1, right.phrase: -1})
            yield left, right


def _random(part: str | int, category: str, seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(derive_seed(seed, SUITE_NAME, category, part)))
