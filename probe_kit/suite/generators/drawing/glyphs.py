"""Twelve small objects to count, legible at a fifth of a tile."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from probe_kit.suite.generators.drawing.canvas import Pen, ellipse, polygon
from probe_kit.suite.generators.drawing.palette import COLORS, RGB, darker

_DARK = (52, 40, 36)
_WOOD = (118, 76, 40)
_LEAF = (36, 138, 52)
_CREAM = (250, 236, 205)
_WHITE = (250, 250, 250)


@dataclass(frozen=True)
class Glyph:
    """A thing with its names, the basic colours it comes in, and how to draw it in the unit disk."""

    singular: str
    plural: str
    colors: tuple[str, ...]
    draw: Callable[[Pen, RGB], None]

    def counted(self, number_word: str) -> str:
        """As in "one leaf" and "three leaves"."""
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
