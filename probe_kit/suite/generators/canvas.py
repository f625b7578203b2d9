"""A canvas for tiles in plain coordinates, drawn at three times the size and reduced once.

Drawings use *drawing units*: x to the right, y down, and everything inside the disk of radius 1.
A `Placement` maps them to *tile units*: the tile spans -1 to 1 on both axes.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from probe_kit.suite.generators.palette import RGB

TILE_PIXELS = 256
_SUPERSAMPLING = 3
_DRAWN_PIXELS = TILE_PIXELS * _SUPERSAMPLING
FULL_DISK = (0.8, 0.89)  # scales for a drawing that fills the unit disk
_FONT_PIXELS = 160
_BOLDNESS = 7  # pixels of that

Points = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """The place of a drawing on its tile; none of it means anything.

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


def random_placement(
    rng: np.random.Generator,
    scales: tuple[float, float] = (0.82, 1.0),
    turn: float = 17,
    mirrored: bool = True,
) -> Placement:
    """A placement for a drawing that has the tile to itself: up to 5 % off centre, up to `turn` degrees turned.

    scales: the range of its radius; a drawing that fills the unit disk leaves the tile above FULL_DISK.
    mirrored: whether it may also be mirrored; not where that would change what is shown, as with lettering.
    """
    return Placement(
        scale=round(rng.uniform(*scales), 4),
        x=round(rng.uniform(-0.1, 0.1), 4),
        y=round(rng.uniform(-0.1, 0.1), 4),
        rotation=round(rng.uniform(-turn, turn), 2),
        mirror=bool(rng.integers(2)) and mirrored,
    )


def polygon(*corners: tuple[float, float]) -> Points:
    """Points (N, 2) with these coordinates."""
    return np.array(corners, dtype=np.float64)


def rectangle(left: float, top: float, right: float, bottom: float) -> Points:
    """The four corners (4, 2) of an upright rectangle."""
    return polygon((left, top), (right, top), (right, bottom), (left, bottom))


def ellipse(x: float, y: float, rx: float, ry: float, start: float = 0, end: float = 360) -> Points:
    """Points (49, 2) along an ellipse from angle `start` to `end` in degrees, 0 to the right, 90 down."""
    angles = np.deg2rad(np.linspace(start, end, 49))
    return np.stack([x + rx * np.cos(angles), y + ry * np.sin(angles)], axis=1)


def tinted(mask: Image.Image, color: RGB) -> Image.Image:
    """RGBA art of one colour with the grey picture `mask` as its opacity."""
    art = Image.new("RGBA", mask.size, color)
    art.putalpha(mask)
    return art


@cache
def _lettering(text: str) -> Image.Image:
    """Text in Pillow's own font, as a grey picture cut to its ink."""
    font = ImageFont.load_default(size=_FONT_PIXELS)
    left, top, right, bottom = font.getbbox(text, stroke_width=_BOLDNESS)
    mask = Image.new("L", (round(right - left), round(bottom - top)))
    ImageDraw.Draw(mask).text((-left, -top), text, fill=255, font=font, stroke_width=_BOLDNESS)
    return mask.crop(mask.getbbox())


class Canvas:
    """One tile in the making."""

    def __init__(self, background: RGB) -> None:
        self._image = Image.new("RGB", (_DRAWN_PIXELS, _DRAWN_PIXELS), background)

    def pen(self, placement: Placement) -> "Pen":
        """A pen that draws at `placement`."""
        return Pen(self._image, placement)

    def picture(self) -> Image.Image:
        """The finished tile, RGB, 256 by 256 pixels."""
        return self._image.resize((TILE_PIXELS, TILE_PIXELS), Image.Resampling.LANCZOS)


@dataclass(frozen=True, kw_only=True)
class Tile:
    """Everything one picture is drawn from: plain values, and so a record of it.

    ink: a colour from which the background stands apart.
    """

    ink: RGB
    background: RGB

    def draw(self) -> Image.Image:
        """The picture, RGB; equal tiles give equal pixels."""
        canvas = Canvas(self.background)
        self._paint(canvas)
        return canvas.picture()

    def _paint(self, canvas: Canvas) -> None:
        raise NotImplementedError


class Pen:
    """Draws in drawing units at one placement."""

    def __init__(self, image: Image.Image, placement: Placement) -> None:
        self._image = image
        self._draw = ImageDraw.Draw(image)
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

    def stamp(self, art: Image.Image, x: float, y: float, height: float) -> None:
        """Ready-made RGBA art with its centre at (x, y); `height` in drawing units, the width follows."""
        pixels_high = height * self._placement.scale * _DRAWN_PIXELS / 2
        size = (round(pixels_high * art.width / art.height), round(pixels_high))
        placed = art.resize(size, Image.Resampling.BICUBIC)
        if self._placement.mirror:
            placed = placed.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
        placed = placed.rotate(-self._placement.rotation, Image.Resampling.BICUBIC, expand=True)
        ((centre_x, centre_y),) = self._pixels(polygon((x, y)))
        corner = round(centre_x - placed.width / 2), round(centre_y - placed.height / 2)
        self._image.paste(placed, corner, placed)

    def text(self, text: str, x: float, y: float, height: float, color: RGB) -> None:
        """Bold lettering with its centre at (x, y); `height` of a capital letter in drawing units."""
        self.stamp(tinted(_lettering(text), color), x, y, height)

    def _pixels(self, points: Points) -> list[tuple[float, float]]:
        pixels = (self._placement.apply(points) + 1) * _DRAWN_PIXELS / 2
        return [(x, y) for x, y in pixels.tolist()]
