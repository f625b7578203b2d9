"""A category of the embedded suite: its concepts, the pairs of them, and the couples of tiles that are drawn."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from probe_kit.hashing import derive_seed, sha256_json
from probe_kit.suite.generators.drawing import Tile, on_hues


@dataclass(frozen=True)
class Concept:
    """The meaning of one picture, and the words that ask for it."""

    name: str
    phrase: str
    polarity: Literal["pos", "neg", "none"] = "none"


@dataclass(frozen=True)
class Generator[C: Concept]:
    """One category of the embedded suite.

    Attributes:
        pairs: Every two concepts that may lie side by side, each couple once.
        tiles: Function that draws the two tiles of a couple. All that does not show the concepts must be drawn for
            both from the same distribution. Another function decides which of the two is asked for.
        name_of: Function that returns the words for what a tile literally shows, which need no knowledge, for the
            wording `named`. They are empty where they say no more than the concept does. None if the category has
            no such words.
    """

    category: str
    pairs: tuple[tuple[C, C], ...]
    tiles: Callable[[C, C, np.random.Generator], tuple[Tile, Tile]]
    name_of: Callable[[Any], str] | None = None


def spread_pairs[C: Concept](
    concepts: Sequence[C], allowed: Callable[[C, C], bool], most: int | None = None
) -> tuple[tuple[C, C], ...]:
    """Return allowed pairs, at most `most`, that use every concept about equally often.

    The concepts stand in a circle, in an order that follows no family; neighbours are paired first, then those
    two places apart, and so on.
    """
    circle = sorted(concepts, key=lambda concept: sha256_json(asdict(concept)))
    size = len(circle)
    pairs = [
        (circle[position], circle[(position + step) % size])
        for step in range(1, size // 2 + 1)
        for position in range(size if 2 * step < size else size // 2)
    ]
    return tuple(pair for pair in pairs if allowed(*pair))[:most]


def half_within[C: Concept](
    concepts: Sequence[C], family: Callable[[C], object], allowed: Callable[[C, C], bool]
) -> tuple[tuple[C, C], ...]:
    """Return all allowed pairs inside one family, and as many across families.

    If most pairs were mixed, a common feature of a family, such as a red ring, would already tell them apart.
    """
    within = spread_pairs(concepts, lambda a, b: family(a) == family(b) and allowed(a, b))
    across = spread_pairs(concepts, lambda a, b: family(a) != family(b) and allowed(a, b), most=len(within))
    return within + across


def each[C: Concept, T: Tile](
    draw: Callable[[C, np.random.Generator], T],
) -> Callable[[C, C, np.random.Generator], tuple[T, T]]:
    """Return a function that draws two tiles, one after the other, from the function that draws one."""
    return lambda left, right, rng: (draw(left, rng), draw(right, rng))


def each_on_hues[C: Concept, T: Tile](
    draw: Callable[[C, np.random.Generator], T],
) -> Callable[[C, C, np.random.Generator], tuple[T, T]]:
    """Return a function that draws two tiles, and then backgrounds of any hue, see `on_hues`."""
    return lambda left, right, rng: on_hues(draw(left, rng), draw(right, rng), rng)


def none_alike[C: Concept](families: Sequence[set[str]]) -> Callable[[C, C], bool]:
    """Return a rule that allows two concepts unless their names are together in one of `families`.

    A family contains names of look-alikes.
    """
    return lambda first, second: not any({first.name, second.name} <= family for family in families)


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
    """Yield endless couples of one category; the first ones are the same, however many are taken."""
    order = _random("order", generator.category, seed)
    for number, (left, right) in enumerate(visiting_order(generator.pairs, order)):
        rng = _random(number, generator.category, seed)
        left_asked_first = bool(rng.integers(2))
        left_tile, right_tile = generator.tiles(left, right, rng)
        yield Couple(left, right, left_tile, right_tile, left_asked_first)


def visiting_order[C: Concept](pairs: Sequence[tuple[C, C]], rng: np.random.Generator) -> Iterator[tuple[C, C]]:
    """Yield endless (left, right) pairs: all of them shuffled, then all of them shuffled again.

    The concept that has been left more often goes right, so that no phrase leans to one side.
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
