"""Counting: "picture with three apples" against one to three apples more or fewer."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from probe_kit.suite.generators.drawing import (
    COLORS,
    RGB,
    Canvas,
    Pen,
    Placement,
    Tile,
    background_for,
    darker,
    ellipse,
    jitter,
    polygon,
)
from probe_kit.suite.generators.generator import Concept, Generator, each

_DARK = (52, 40, 36)
_WOOD = (118, 76, 40)
_LEAF = (36, 138, 52)
_CREAM = (250, 236, 205)
_WHITE = (250, 250, 250)


@dataclass(frozen=True)
class Glyph:
    """A thing with its names, its possible basic colours, and a function that draws it in the unit disk."""

    singular: str
    plural: str
    colors: tuple[str, ...]
    draw: Callable[[Pen, RGB], None]

    def counted(self, number_word: str) -> str:
        """Return the counted name, such as "one leaf" and "three leaves"."""
        return f"{number_word} {self.singular if number_word == 'one' else self.plural}"


def _apple(pen: Pen, color: RGB) -> None:
    pen.line(polygon((0, -0.4), (0.08, -0.9)), _WOOD, 0.15)
    pen.fill(ellipse(0.42, -0.68, 0.36, 0.18), _LEAF)
    pen.fill(ellipse(-0.3, 0.12, 0.6, 0.66), color)
    pen.fill(ellipse(0.3, 0.12, 0.6, 0.66), color)
    pen.fill(ellipse(0, 0.3, 0.62, 0.62), color)


def _lemon(pen: Pen, color: RGB) -> None:
    pen.fill(ellipse(0, 0, 0.78, 0.6), color)
    pen.fill(ellipse(0.74, 0, 0.22, 0.2), color)
    pen.fill(ellipse(-0.74, 0, 0.22, 0.2), color)
    pen.line(ellipse(0, 0, 0.5, 0.36, 190, 260), _WHITE, 0.1)


def _fish(pen: Pen, color: RGB) -> None:
    pen.fill(polygon((0.35, 0), (0.95, -0.55), (0.82, 0), (0.95, 0.55)), color)
    pen.fill(ellipse(-0.2, 0, 0.76, 0.52), color)
    pen.line(ellipse(-0.55, 0, 0.3, 0.4, -70, 70), darker(color), 0.08)
    pen.fill(ellipse(-0.58, -0.12, 0.13, 0.13), _WHITE)
    pen.fill(ellipse(-0.6, -0.12, 0.07, 0.07), _DARK)


def _flower(pen: Pen, color: RGB) -> None:
    for angle in np.deg2rad(np.arange(0, 360, 72) - 90):
        pen.fill(ellipse(0.56 * np.cos(angle), 0.56 * np.sin(angle), 0.4, 0.4), color)
    pen.fill(ellipse(0, 0, 0.34, 0.34), COLORS["yellow"])
    pen.outline(ellipse(0, 0, 0.34, 0.34), darker(COLORS["yellow"]), 0.06)


def _leaf(pen: Pen, color: RGB) -> None:
    upper, lower = ellipse(0.1, 0.35, 0.9, 1.0, 200, 340), ellipse(0.1, -0.35, 0.9, 1.0, 20, 160)
    pen.fill(np.vstack([upper, lower]), color)
    pen.line(polygon((-0.95, 0), (0.6, 0)), darker(color), 0.12)
    for x in (-0.35, 0.1):
        pen.line(polygon((x + 0.25, -0.35), (x, 0), (x + 0.25, 0.35)), darker(color), 0.09)


def _balloon(pen: Pen, color: RGB) -> None:
    pen.line(polygon((0, 0.4), (0.1, 0.62), (-0.06, 0.8), (0.04, 0.97)), _DARK, 0.08)
    pen.fill(polygon((0, 0.3), (-0.18, 0.56), (0.18, 0.56)), darker(color))
    pen.fill(ellipse(0, -0.26, 0.6, 0.68), color)
    pen.line(ellipse(0, -0.26, 0.36, 0.44, 190, 250), _WHITE, 0.1)


def _mushroom(pen: Pen, color: RGB) -> None:
    stem = polygon((-0.22, 0), (0.22, 0), (0.3, 0.85), (-0.3, 0.85))
    pen.fill(stem, _CREAM)
    pen.outline(stem, _DARK, 0.06)
    pen.fill(ellipse(0, 0.12, 0.92, 0.9, 180, 360), color)
    for x, y, radius in ((-0.46, -0.18, 0.14), (0.06, -0.42, 0.17), (0.5, -0.12, 0.13)):
        pen.fill(ellipse(x, y, radius, radius), _WHITE)


def _house(pen: Pen, color: RGB) -> None:
    pen.fill(polygon((-0.62, -0.1), (0.62, -0.1), (0.62, 0.75), (-0.62, 0.75)), color)
    pen.fill(polygon((-0.9, -0.05), (0, -0.9), (0.9, -0.05)), darker(COLORS["red"]))
    pen.fill(polygon((-0.16, 0.2), (0.2, 0.2), (0.2, 0.75), (-0.16, 0.75)), _DARK)


def _cup(pen: Pen, color: RGB) -> None:
    pen.outline(ellipse(0.5, -0.02, 0.36, 0.34), color, 0.16)
    pen.fill(polygon((-0.75, -0.62), (0.55, -0.62), (0.38, 0.68), (-0.58, 0.68)), color)
    pen.fill(ellipse(-0.1, -0.62, 0.65, 0.18), darker(color))


def _butterfly(pen: Pen, color: RGB) -> None:
    for side in (-1, 1):
        pen.fill(ellipse(side * 0.48, -0.32, 0.46, 0.5), color)
        pen.fill(ellipse(side * 0.4, 0.42, 0.36, 0.38), color)
        pen.fill(ellipse(side * 0.52, -0.34, 0.18, 0.2), _WHITE)
        pen.line(polygon((0, -0.5), (side * 0.24, -0.92)), _DARK, 0.07)
    pen.line(polygon((0, -0.5), (0, 0.68)), _DARK, 0.2)


def _tree(pen: Pen, color: RGB) -> None:
    pen.fill(polygon((-0.15, 0.1), (0.15, 0.1), (0.2, 0.95), (-0.2, 0.95)), _WOOD)
    pen.fill(polygon((0, -0.95), (-0.5, -0.2), (0.5, -0.2)), color)
    pen.fill(polygon((0, -0.6), (-0.66, 0.22), (0.66, 0.22)), color)
    pen.fill(polygon((0, -0.2), (-0.76, 0.6), (0.76, 0.6)), color)


def _boat(pen: Pen, color: RGB) -> None:
    pen.line(polygon((0, 0.4), (0, -0.88)), _DARK, 0.1)
    pen.fill(polygon((0.08, -0.8), (0.08, 0.22), (0.68, 0.22)), color)
    pen.fill(polygon((-0.08, -0.5), (-0.08, 0.22), (-0.52, 0.22)), color)
    pen.fill(polygon((-0.88, 0.34), (0.88, 0.34), (0.5, 0.8), (-0.5, 0.8)), _WOOD)


GLYPHS: dict[str, Glyph] = {
    glyph.singular: glyph
    for glyph in (
        Glyph("apple", "apples", ("red", "green"), _apple),
        Glyph("lemon", "lemons", ("yellow",), _lemon),
        Glyph("fish", "fish", ("orange", "blue", "purple"), _fish),
        Glyph("flower", "flowers", ("red", "pink", "purple", "blue"), _flower),
        Glyph("leaf", "leaves", ("green", "orange", "brown"), _leaf),
        Glyph("balloon", "balloons", ("red", "blue", "purple", "green"), _balloon),
        Glyph("mushroom", "mushrooms", ("red", "brown"), _mushroom),
        Glyph("house", "houses", ("blue", "yellow", "white"), _house),
        Glyph("cup", "cups", ("blue", "red", "green", "purple"), _cup),
        Glyph("butterfly", "butterflies", ("orange", "blue", "purple"), _butterfly),
        Glyph("tree", "trees", ("green",), _tree),
        Glyph("boat", "boats", ("white", "red", "yellow"), _boat),
    )
}


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
class Scatter(Tile):
    """Everything that the picture is drawn from: equal glyphs, spread without overlap."""

    glyph: str
    color: str
    placements: tuple[Placement, ...]

    def _paint(self, canvas: Canvas) -> None:
        for placement in self.placements:
            GLYPHS[self.glyph].draw(canvas.pen(placement), self.ink)


def _radius(number: int, rng: np.random.Generator) -> float:
    """Draw the radius of each glyph in tile units.

    In half of the tiles all ink together is fixed, in half each glyph. With only one of the two rules, the number
    could be read off the ink or off the size of a single glyph.
    """
    if rng.integers(2):
        return float(rng.uniform(*_FIXED_RADIUS))
    return float(np.sqrt(rng.uniform(*_INK_BUDGET) / number))


def _centres(number: int, radius: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Draw centres of disks that neither overlap nor leave the tile; start over when a disk finds no room."""
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
    ink = jitter(COLORS[color], rng)
    radius = round(_radius(concept.number, rng), 4)
    placements = tuple(
        Placement(radius, x, y, round(rng.uniform(-_MAX_TURN, _MAX_TURN), 2), bool(rng.integers(2)))
        for x, y in _centres(concept.number, radius, rng)
    )
    return Scatter(concept.glyph, color, placements, ink=ink, background=background_for(ink, rng))


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
    tiles=each(_scatter),
)
