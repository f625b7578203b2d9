"""Counting: "picture with three apples" against one to three apples more or fewer."""

from dataclasses import dataclass

import numpy as np
from PIL import Image

from probe_kit.suite.generators.drawing.canvas import Canvas, Placement
from probe_kit.suite.generators.drawing.glyphs import GLYPHS
from probe_kit.suite.generators.drawing.palette import COLORS, RGB, background_for, jittered
from probe_kit.suite.generators.generator import Concept, Generator

_NUMBERS = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
_LARGEST_DIFFERENCE = 3

_MARGIN = 0.95  # nothing is drawn further from the tile's centre, in tile units
_GAP = 1.06  # centres lie this many diameters apart
_FIXED_RADIUS = (0.20, 0.23)  # a fifth of the tile across, the least that stays legible
_INK_BUDGET = (0.36, 0.50)  # sum of squared radii: nine glyphs of the least size, one of three times that
_MAX_TURN = 15
_THROWS = 60


@dataclass(frozen=True)
class Count(Concept):
    """A number of glyphs of one kind."""

    number: int = 0
    glyph: str = ""


@dataclass(frozen=True)
class Scatter:
    """Everything the picture is drawn from: equal glyphs, spread without overlap."""

    glyph: str
    color: str
    ink: RGB
    background: RGB
    placements: tuple[Placement, ...]

    def draw(self) -> Image.Image:
        """The tile, RGB."""
        canvas = Canvas(self.background)
        for placement in self.placements:
            GLYPHS[self.glyph].draw(canvas.pen(placement), self.ink)
        return canvas.picture()


def _radius(number: int, rng: np.random.Generator) -> float:
    """Radius of each glyph in tile units; in half of the tiles all ink together is fixed, in half each glyph.

    With only one of the two rules, the number could be read off the ink or off the size of a single glyph.
    """
    if rng.integers(2):
        return float(rng.uniform(*_FIXED_RADIUS))
    return float(np.sqrt(rng.uniform(*_INK_BUDGET) / number))


def _centres(number: int, radius: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Centres of disks that neither overlap nor leave the tile; starts over when a disk finds no room."""
    reach = _MARGIN - radius
    while True:
        centres: list[tuple[float, float]] = []
        for x, y in rng.uniform(-reach, reach, size=(_THROWS, 2)).round(4).tolist():
            if all(np.hypot(x - a, y - b) > 2 * radius * _GAP for a, b in centres):
                centres.append((x, y))
            if len(centres) == number:
                return centres


def _scatter(concept: Count, rng: np.random.Generator) -> Scatter:
    color = str(rng.choice(GLYPHS[concept.glyph].colors))
    ink = jittered(COLORS[color], rng)
    radius = round(_radius(concept.number, rng), 4)
    placements = tuple(
        Placement(radius, x, y, round(rng.uniform(-_MAX_TURN, _MAX_TURN), 2), bool(rng.integers(2)))
        for x, y in _centres(concept.number, radius, rng)
    )
    return Scatter(concept.glyph, color, ink, background_for(ink, rng), placements)


def _tiles(left: Count, right: Count, rng: np.random.Generator) -> tuple[Scatter, Scatter]:
    return _scatter(left, rng), _scatter(right, rng)


def _count(number: int, glyph: str) -> Count:
    word = _NUMBERS[number - 1]
    return Count(word, f"picture with {GLYPHS[glyph].counted(word)}", number=number, glyph=glyph)


COUNTING = Generator(
    category="counting",
    pairs=tuple(
        (_count(fewer, glyph), _count(more, glyph))
        for glyph in GLYPHS
        for fewer in range(1, len(_NUMBERS) + 1)
        for more in range(fewer + 1, min(fewer + _LARGEST_DIFFERENCE, len(_NUMBERS)) + 1)
    ),
    tiles=_tiles,
)
