"""A tile to draw on: plain coordinates, drawn three times too large and shrunk once.

Drawings use *drawing units*: x to the right, y down, and everything inside the disk of radius 1.
A `Placement` maps them to *tile units*: the tile spans -1 to 1 on both axes.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from probe_kit.suite.generators.palette import RGB

TILE_PIXELS = 256
_SUPERSAMPLING = 3
_DRAWN_PIXELS = TILE_PIXELS * _SUPERSAMPLING

Points = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """Where a drawing lies on its tile; none of it means anything.

    scale is the radius of the drawing and x, y its centre, in tile units; rotation is in degrees.
    """

    scale: float
    x: float
    y: float
    rotation: float
    mirror: bool

    def apply(self, points: Points) -> Points:
        """Drawing units (N, 2) to tile units (N, 2)."""
        angle = np.deg2rad(self.rotation)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        flip = np.array([-1.0 if self.mirror else 1.0, 1.0])
        placed: Points = (points * flip) @ turn.T * self.scale + np.array([self.x, self.y])
        return placed


def random_placement(rng: np.random.Generator) -> Placement:
    """A placement for a drawing that has the tile to itself: up to 5 % off centre, up to 17 degrees turned."""
    return Placement(
        scale=round(rng.uniform(0.82, 1.0), 4),
        x=round(rng.uniform(-0.1, 0.1), 4),
        y=round(rng.uniform(-0.1, 0.1), 4),
        rotation=round(rng.uniform(-17, 17), 2),
        mirror=bool(rng.integers(2)),
    )


def ellipse(x: float, y: float, rx: float, ry: float, start: float = 0, end: float = 360) -> Points:
    """Points (49, 2) along an ellipse from angle `start` to `end` in degrees, 0 to the right, 90 down."""
    angles = np.deg2rad(np.linspace(start, end, 49))
    return np.stack([x + rx * np.cos(angles), y + ry * np.sin(angles)], axis=1)


class Canvas:
    """One tile in the making."""

    def __init__(self, background: RGB) -> None:
        self._image = Image.new("RGB", (_DRAWN_PIXELS, _DRAWN_PIXELS), background)
        self._draw = ImageDraw.Draw(self._image)

    def pen(self, placement: Placement) -> "Pen":
        """A pen that draws at `placement`."""
        return Pen(self._draw, placement)

    def picture(self) -> Image.Image:
        """The finished tile, RGB, 256 by 256 pixels."""
        return self._image.resize((TILE_PIXELS, TILE_PIXELS), Image.Resampling.LANCZOS)


class Pen:
    """Draws in drawing units at one placement."""

    def __init__(self, draw: ImageDraw.ImageDraw, placement: Placement) -> None:
        self._draw = draw
        self._placement = placement

    def fill(self, points: Points, color: RGB) -> None:
        """A filled polygon with corners `points` (N, 2)."""
        self._draw.polygon(self._pixels(points), fill=color)

    def line(self, points: Points, color: RGB, width: float) -> None:
        """An open line through `points` (N, 2) with round ends; `width` in drawing units."""
        pixels = self._pixels(points)
        stroke = width * self._placement.scale * _DRAWN_PIXELS / 2
        self._draw.line(pixels, fill=color, width=round(stroke), joint="curve")
        for x, y in (pixels[0], pixels[-1]):
            self._draw.circle((x, y), stroke / 2, fill=color)

    def outline(self, points: Points, color: RGB, width: float) -> None:
        """A closed line around the polygon `points` (N, 2); `width` in drawing units."""
        self.line(np.vstack([points, points[:1]]), color, width)

    def _pixels(self, points: Points) -> list[tuple[float, float]]:
        pixels = (self._placement.apply(points) + 1) * _DRAWN_PIXELS / 2
        return [(x, y) for x, y in pixels.tolist()]
