"""Attribute: "longer pencil" and "shorter pencil", asked of the same two pencils."""

import colorsys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from probe_kit.suite.generators.drawing import (
    COLORS,
    RGB,
    SHIRT,
    Canvas,
    Pen,
    Placement,
    Points,
    Tile,
    background_for,
    darker,
    ellipse,
    jitter,
    on_hues,
    polygon,
    random_placement,
    rectangle,
)
from probe_kit.suite.generators.generator import Concept, Generator

_DARK: RGB = (40, 36, 36)
_WHITE: RGB = (250, 250, 250)
_WOOD: RGB = (226, 182, 120)

Draw = Callable[[Pen, float, RGB], None]


@dataclass(frozen=True)
class Gradable:
    """A thing that is asked for by more or by less of one property.

    Attributes:
        more: Phrase for the thing with more of the property.
        less: Phrase for the thing with less of it.
        draw: Function that draws the thing with a pen, a level from 0 to 1, and a colour.
        shaded: Whether the shade of its colour is the level; else its colour is free.
        upright: Whether it must not be turned, because a turn would change the property.
    """

    more: str
    less: str
    draw: Draw
    shaded: bool = False
    upright: bool = False


def _pencil(pen: Pen, level: float, color: RGB) -> None:
    end = -0.9 + 0.45 + 1.1 * level
    pen.fill(rectangle(-0.9, -0.17, end, 0.17), color)
    pen.fill(rectangle(-0.9, -0.17, -0.74, 0.17), (240, 140, 160))
    pen.fill(polygon((end, -0.17), (end + 0.26, 0), (end, 0.17)), _WOOD)
    pen.fill(polygon((end + 0.15, -0.07), (end + 0.26, 0), (end + 0.15, 0.07)), _DARK)


def _ball(pen: Pen, level: float, color: RGB) -> None:
    radius = 0.26 + 0.66 * level
    pen.fill(ellipse(0, 0, radius, radius), color)
    pen.line(ellipse(0, 0, 0.62 * radius, 0.62 * radius, 190, 260), _WHITE, 0.12 * radius)
    pen.outline(ellipse(0, 0, radius, radius), _DARK, 0.04)


def _tree(pen: Pen, level: float, color: RGB) -> None:
    top = 0.9 - (0.55 + 1.2 * level)
    pen.fill(rectangle(-0.1, 0.3, 0.1, 0.9), (112, 72, 40))
    pen.fill(polygon((0, top), (0.46, 0.66), (-0.46, 0.66)), color)
    pen.line(polygon((-0.7, 0.9), (0.7, 0.9)), _DARK, 0.06)


def _thick_line(pen: Pen, level: float, color: RGB) -> None:
    x = np.linspace(-0.78, 0.78, 41)
    arc = np.stack([x, 0.5 * np.cos(x / 0.78 * np.pi / 2) - 0.25], axis=1)
    pen.line(arc, color, 0.07 + 0.4 * level)


def _striped_shirt(pen: Pen, level: float, color: RGB) -> None:
    pen.fill(SHIRT, color)
    count = 1 + round(6 * level)
    for y in np.linspace(-0.2, 0.68, count + 2)[1:-1] if count > 1 else [0.2]:
        pen.fill(rectangle(-0.5, y - 0.045, 0.5, y + 0.045), _WHITE)
    pen.outline(SHIRT, _DARK, 0.04)


def _wavy_line(pen: Pen, level: float, color: RGB) -> None:
    x = np.linspace(-0.8, 0.8, 121)
    for y in (-0.45, 0.1, 0.65):
        wave = y - 0.1 + 0.24 * level * np.sin(x / 0.8 * 3 * np.pi)
        pen.line(np.stack([x, wave], axis=1), color, 0.1)


_SPOTS = (
    *((-0.22, 0.3), (0.26, 0.5), (0.02, -0.1), (-0.36, 0.66), (0.3, 0.12)),
    *((0.0, 0.72), (-0.14, -0.38), (0.16, -0.36), (0.02, 0.36)),
)


def _spotted_dress(pen: Pen, level: float, color: RGB) -> None:
    dress = polygon((-0.26, -0.84), (0.26, -0.84), (0.24, -0.24), (0.66, 0.88), (-0.66, 0.88), (-0.24, -0.24))
    pen.fill(dress, color)
    for x, y in _SPOTS[: 1 + round(8 * level)]:
        pen.fill(ellipse(x, y, 0.1, 0.1), _WHITE)
    pen.outline(dress, _DARK, 0.04)


def _car(pen: Pen, level: float, color: RGB) -> None:
    body = polygon(
        *((-0.92, 0.3), (-0.88, -0.06), (-0.56, -0.14), (-0.34, -0.5), (0.34, -0.5)),
        *((0.6, -0.14), (0.9, -0.06), (0.92, 0.3)),
    )
    del level  # the shade is the level
    pen.fill(body, color)
    pen.outline(body, _DARK, 0.05)
    pen.fill(polygon((-0.4, -0.14), (-0.27, -0.4), (-0.04, -0.4), (-0.04, -0.14)), (200, 226, 246))
    pen.fill(polygon((0.06, -0.14), (0.06, -0.4), (0.28, -0.4), (0.44, -0.14)), (200, 226, 246))
    for x in (-0.5, 0.5):
        pen.fill(ellipse(x, 0.32, 0.2, 0.2), _DARK)
        pen.fill(ellipse(x, 0.32, 0.09, 0.09), (190, 190, 190))


def _stone(pen: Pen, level: float, color: RGB) -> None:
    aspect = 0.28 + 0.72 * level
    radius = 0.72 / np.sqrt(aspect) if aspect > 0.6 else 0.92
    pen.fill(ellipse(0, 0, radius, radius * aspect), color)
    pen.outline(ellipse(0, 0, radius, radius * aspect), _DARK, 0.05)


def _tower(pen: Pen, level: float, color: RGB) -> None:
    angle = np.deg2rad(34 * level)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    foot = np.array([0, 0.75])

    def leaning(points: Points) -> Points:
        leant: Points = (points - foot) @ turn + foot
        return leant

    pen.fill(leaning(rectangle(-0.24, -0.66, 0.24, 0.75)), color)
    for y in (-0.4, 0.0, 0.4):
        pen.fill(leaning(rectangle(-0.1, y - 0.1, 0.1, y + 0.1)), _WHITE)
    pen.outline(leaning(rectangle(-0.24, -0.66, 0.24, 0.75)), _DARK, 0.04)
    pen.line(polygon((-0.6, 0.78), (0.6, 0.78)), _DARK, 0.08)


_TREES = (
    *((-0.5, 0.5), (0.45, -0.1), (-0.05, -0.45), (0.1, 0.6), (-0.55, -0.1), (0.6, 0.42)),
    *((0.0, 0.1), (-0.28, 0.32), (0.32, 0.26), (0.35, -0.5), (-0.4, -0.5)),
)


def _forest(pen: Pen, level: float, color: RGB) -> None:
    standing = sorted(_TREES[: 2 + round(9 * level)], key=lambda tree: tree[1])
    for x, y in standing:
        pen.fill(rectangle(x - 0.04, y, x + 0.04, y + 0.26), (112, 72, 40))
        pen.fill(polygon((x, y - 0.32), (x + 0.22, y + 0.14), (x - 0.22, y + 0.14)), color)
        pen.outline(polygon((x, y - 0.32), (x + 0.22, y + 0.14), (x - 0.22, y + 0.14)), darker(color), 0.03)


def _glass(pen: Pen, level: float, color: RGB) -> None:
    def wall(y: float) -> float:
        return 0.56 - 0.16 * (y + 0.8) / 1.65

    def inside(top: float) -> Points:
        return polygon((-wall(top), top), (wall(top), top), (wall(bottom), bottom), (-wall(bottom), bottom))

    brim, bottom = -0.8, 0.85
    pen.fill(inside(brim), _WHITE)
    pen.fill(inside(bottom - 0.08 - 1.4 * level), color)
    pen.line(np.roll(inside(brim), -1, axis=0), _DARK, 0.07)


def _box(pen: Pen, level: float, color: RGB) -> None:
    half = 0.2 + 0.65 * level
    pen.fill(rectangle(-half, -0.4, half, 0.4), color)
    pen.fill(rectangle(-half, -0.09, half, 0.09), darker(color))
    pen.outline(rectangle(-half, -0.4, half, 0.4), _DARK, 0.05)


def _star(pen: Pen, level: float, color: RGB) -> None:
    angles = np.deg2rad(np.arange(0, 360, 30) - 90)
    radii = np.where(np.arange(12) % 2, 0.92 - 0.66 * level, 0.92)
    pen.fill(np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1), color)


def _distant_dots(pen: Pen, level: float, color: RGB) -> None:
    for side in (-1, 1):
        pen.fill(ellipse(side * (0.22 + 0.5 * level), 0, 0.2, 0.2), color)
        pen.outline(ellipse(side * (0.22 + 0.5 * level), 0, 0.2, 0.2), _DARK, 0.04)


def _window(pen: Pen, level: float, color: RGB) -> None:
    """Draw a veil of `color` in front of a checkerboard; the more transparent, the more of the board shows."""
    for row in range(4):
        for column in range(4):
            behind = _WHITE if (row + column) % 2 else _DARK
            red, green, blue = (round(b * level + c * (1 - level)) for b, c in zip(behind, color, strict=True))
            x, y = -0.68 + 0.34 * column, -0.68 + 0.34 * row
            pen.fill(rectangle(x, y, x + 0.34, y + 0.34), (red, green, blue))
    pen.outline(rectangle(-0.68, -0.68, 0.68, 0.68), (112, 72, 40), 0.1)


def _hair(pen: Pen, level: float, color: RGB) -> None:
    end = -0.2 + 1.1 * level
    pen.fill(np.vstack([ellipse(0, -0.24, 0.56, 0.58, 180, 360), polygon((0.56, end), (-0.56, end))]), color)
    pen.fill(ellipse(0, -0.12, 0.4, 0.5), (240, 200, 165))
    pen.fill(ellipse(0, -0.44, 0.42, 0.26, 180, 360), color)
    for x in (-0.15, 0.15):
        pen.fill(ellipse(x, -0.12, 0.06, 0.06), _DARK)
    pen.line(ellipse(0, 0.06, 0.14, 0.1, 20, 160), (150, 40, 40), 0.06)


def _hill(pen: Pen, level: float, color: RGB) -> None:
    rise = 0.15 + 1.2 * level
    pen.fill(polygon((-0.75, 0.7), (0.55, 0.7 - rise), (0.55, 0.7)), color)
    pen.outline(polygon((-0.75, 0.7), (0.55, 0.7 - rise), (0.55, 0.7)), _DARK, 0.05)


GRADABLES: tuple[Gradable, ...] = (
    Gradable("longer pencil", "shorter pencil", _pencil),
    Gradable("bigger ball", "smaller ball", _ball),
    Gradable("taller tree", "shorter tree", _tree),
    Gradable("thicker line", "thinner line", _thick_line),
    Gradable("shirt with more stripes", "shirt with fewer stripes", _striped_shirt),
    Gradable("wavier lines", "straighter lines", _wavy_line),
    Gradable("dress with more spots", "dress with fewer spots", _spotted_dress),
    Gradable("darker car", "lighter car", _car, shaded=True),
    Gradable("rounder stone", "flatter stone", _stone),
    Gradable("more tilted tower", "less tilted tower", _tower, upright=True),
    Gradable("denser forest", "sparser forest", _forest),
    Gradable("fuller glass", "emptier glass", _glass),
    Gradable("wider box", "narrower box", _box),
    Gradable("sharper star", "blunter star", _star),
    Gradable("dots farther apart", "dots closer together", _distant_dots),
    Gradable("more transparent window", "less transparent window", _window),
    Gradable("person with longer hair", "person with shorter hair", _hair),
    Gradable("steeper hill", "flatter hill", _hill, upright=True),
)


_GAP = (0.45, 0.6)  # between the two levels; a smaller one vanishes on the far tile
_SCALES = (0.84, 0.89)  # so little that a smaller scale never looks like a smaller thing
_INKS = ("red", "green", "blue", "orange", "brown", "purple", "gray")
_LIGHTEST, _DARKEST = 0.95, 0.2  # value of a shaded thing
_BY_NAME = {name: gradable for gradable in GRADABLES for name in (gradable.more, gradable.less)}


@dataclass(frozen=True)
class Sample(Tile):
    """Everything that the picture is drawn from: a gradable, by its word for more, with this much of it."""

    more: str
    level: float
    placement: Placement

    def record(self) -> dict[str, Any]:
        """Return the values under the keys of hashed items, in which the word for more is called `thing`."""
        return {"thing" if name == "more" else name: value for name, value in super().record().items()}

    def _paint(self, canvas: Canvas) -> None:
        _BY_NAME[self.more].draw(canvas.pen(self.placement), self.level, self.ink)


def _sample(gradable: Gradable, level: float, rng: np.random.Generator) -> Sample:
    color = COLORS[str(rng.choice(_INKS))]
    ink = _shade(level, rng) if gradable.shaded else jitter(color, rng)
    placement = random_placement(rng, _SCALES, turn=2 if gradable.upright else 10)
    return Sample(gradable.more, round(level, 3), placement, ink=ink, background=background_for(ink, rng))


def _shade(level: float, rng: np.random.Generator) -> RGB:
    """Return a colour of any hue, as dark as the level says."""
    value = _LIGHTEST + level * (_DARKEST - _LIGHTEST)
    red, green, blue = colorsys.hsv_to_rgb(rng.uniform(), 0.35, value)
    return round(255 * red), round(255 * green), round(255 * blue)


def _tiles(left: Concept, right: Concept, rng: np.random.Generator) -> tuple[Sample, Sample]:
    """Draw two tiles whose levels are a good way apart, anywhere in the range."""
    gap = rng.uniform(*_GAP)
    low = rng.uniform(0, 1 - gap)
    levels = {"neg": low, "pos": low + gap}
    left_tile, right_tile = (_sample(_BY_NAME[c.name], float(levels[c.polarity]), rng) for c in (left, right))
    return on_hues(left_tile, right_tile, rng)


ATTRIBUTE = Generator(
    category="attribute",
    pairs=tuple(
        (Concept(gradable.more, gradable.more, "pos"), Concept(gradable.less, gradable.less, "neg"))
        for gradable in GRADABLES
    ),
    tiles=_tiles,
)
