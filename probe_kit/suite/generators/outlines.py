"""Fifteen outlines as polygons of equal area, and the tile that shows one: the picture of Color and Shape items.

Equal areas, so that the area of ink does not identify the outline.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from probe_kit.suite.generators.canvas import Canvas, Placement, Points, Tile, ellipse, polygon, random_placement
from probe_kit.suite.generators.palette import COLORS, background_for, jittered

_AREA = 0.95**2  # in drawing units; the most that keeps every placement of every outline on its tile


def _regular(corners: int) -> Points:
    angles = np.linspace(0, 2 * np.pi, corners, endpoint=False) - np.pi / 2
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _star() -> Points:
    star = _regular(10)
    star[1::2] *= 0.48
    return star


def _heart() -> Points:
    t = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    x = 16 * np.sin(t) ** 3
    y = 13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t)
    return np.stack([x, -y], axis=1)


def _cross(arm: float = 0.38) -> Points:
    quarter = polygon((arm, arm), (1, arm), (1, -arm))
    turn = polygon((0, -1), (1, 0))
    corners = [quarter]
    for _ in range(3):
        corners.append(corners[-1] @ turn)
    return np.vstack(corners)


def _matched(points: Points) -> Points:
    """The same outline with the shared area and its bounding box centred on the origin."""
    x, y = points.T
    area = abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2
    centred = points - (points.min(axis=0) + points.max(axis=0)) / 2
    matched: Points = centred * np.sqrt(_AREA / area)
    matched.setflags(write=False)
    return matched


_DRAWN: dict[str, Points] = {
    "circle": ellipse(0, 0, 1, 1)[:-1],
    "oval": ellipse(0, 0, 1.6, 1)[:-1],
    "triangle": _regular(3),
    "right triangle": polygon((-1, 1), (1, 1), (-1, -0.9)),
    "square": polygon((-1, -1), (1, -1), (1, 1), (-1, 1)),
    "rectangle": polygon((-1.75, -1), (1.75, -1), (1.75, 1), (-1.75, 1)),
    "trapezoid": polygon((-0.5, -0.65), (0.5, -0.65), (1.1, 0.65), (-1.1, 0.65)),
    "parallelogram": polygon((-0.6, -0.65), (1.3, -0.65), (0.6, 0.65), (-1.3, 0.65)),
    "diamond": polygon((0, -1.45), (1, 0), (0, 1.45), (-1, 0)),
    "pentagon": _regular(5),
    "hexagon": _regular(6),
    "star": _star(),
    "heart": _heart(),
    "cross": _cross(),
    "arrow": polygon((-1.1, -0.36), (0.1, -0.36), (0.1, -0.9), (1.1, 0), (0.1, 0.9), (0.1, 0.36), (-1.1, 0.36)),
}
OUTLINES: dict[str, Points] = {name: _matched(points) for name, points in _DRAWN.items()}


# edged: filled, with a thin dark edge; plain: filled; hollow: a thick line only
Style = Literal["edged", "plain", "hollow"]

_EDGE = (38, 38, 38)
_EDGE_WIDTH = 0.025
_HOLLOW_WIDTH = 0.15


@dataclass(frozen=True)
class Figure(Tile):
    """Everything the picture is drawn from."""

    color: str
    outline: str
    style: Style
    placement: Placement

    def _paint(self, canvas: Canvas) -> None:
        pen = canvas.pen(self.placement)
        corners = OUTLINES[self.outline]
        if self.style == "hollow":
            inner = corners * (1 - _HOLLOW_WIDTH / 2)  # half of the line lies outside of its corners
            pen.outline(inner, self.ink, _HOLLOW_WIDTH)
        else:
            pen.fill(corners, self.ink)
        if self.style == "edged":
            pen.outline(corners, _EDGE, _EDGE_WIDTH)


def colored_outline(figure: Figure) -> str:
    """The figure in words, such as "red circle"."""
    return f"{figure.color} {figure.outline}"


def random_figure(color: str, outline: str, style: Style, rng: np.random.Generator) -> Figure:
    """A figure of this colour and outline with everything else drawn from `rng`."""
    ink = jittered(COLORS[color], rng)
    background = background_for(ink, rng)
    return Figure(color, outline, style, random_placement(rng), ink=ink, background=background)
