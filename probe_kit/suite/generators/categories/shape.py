"""Shape: "triangle" against another, clearly different outline."""

from itertools import combinations

import numpy as np

from probe_kit.suite.generators.generator import Concept, Generator
from probe_kit.suite.generators.outlines import OUTLINES, Figure, colored_outline, random_figure
from probe_kit.suite.generators.palette import COLORS, on_hues

_HOLLOW_SHARE = 0.3
_CONFUSABLE = (
    {"square", "rectangle", "diamond", "parallelogram"},
    {"trapezoid", "rectangle", "parallelogram"},
    {"circle", "oval"},
    {"pentagon", "hexagon"},
)

# "right triangle" can be drawn but not asked for: its name holds a side word.
_NAMES = [name for name in OUTLINES if name != "right triangle"]


def _distinct(first: Concept, second: Concept) -> bool:
    return not any({first.name, second.name} <= family for family in _CONFUSABLE)


def _figure(concept: Concept, rng: np.random.Generator) -> Figure:
    color = str(rng.choice(list(COLORS)))
    return random_figure(color, concept.name, "hollow" if rng.random() < _HOLLOW_SHARE else "plain", rng)


def _tiles(left: Concept, right: Concept, rng: np.random.Generator) -> tuple[Figure, Figure]:
    return on_hues(_figure(left, rng), _figure(right, rng), rng)


SHAPE = Generator(
    category="shape",
    pairs=tuple(
        (first, second)
        for first, second in combinations([Concept(name, name) for name in _NAMES], 2)
        if _distinct(first, second)
    ),
    tiles=_tiles,
    name_of=colored_outline,
)
