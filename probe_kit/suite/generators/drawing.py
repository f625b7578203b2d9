"""Drawing of tiles: colours and backgrounds, a canvas in plain coordinates, and icons.

Drawings use *drawing units*: x to the right, y down, and everything inside the disk of radius 1. A `Placement`
maps them to *tile units*: the tile spans -1 to 1 on both axes. A tile is drawn at three times the size and reduced
once.

Concepts recur in other pictures, so a probe can learn by itself which pixels answer which word (see the control
`random-features`). The concept should recur, and little else. So the background has any hue, and where size means
nothing, drawings have different sizes anywhere on their tile.

Icons are rendered once by `scripts/build_suite_art.py` and shipped with their licences. The folder `suite/art/`
contains two sheets of 128 px cells, `fluent.png` in colour and `material.png` as grey masks. The file `index.json`
has the icon names in the order of the cells. The notice `suite/art/NOTICE.md` names their origin.
"""

import colorsys
import json
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from probe_kit.suite.pictures import stored_picture

RGB = tuple[int, int, int]

COLORS: dict[str, RGB] = {
    "black": (20, 20, 20),
    "white": (248, 248, 248),
    "gray": (128, 128, 128),
    "red": (214, 30, 34),
    "green": (30, 150, 56),
    "blue": (34, 82, 214),
    "yellow": (252, 224, 36),
    "orange": (245, 130, 18),
    "brown": (118, 70, 32),
    "pink": (248, 138, 192),
    "purple": (122, 46, 176),
}

INK_CONTRAST = 40
_JITTER = 14
_HUE_JITTER = 5 / 360
_BACKGROUND_LIGHTNESS = (150, 246)
_TINT = 12


def jitter(color: RGB, rng: np.random.Generator) -> RGB:
    """Draw a shade that still has the same name: up to 14 levels off, and 5 degrees in hue.

    Moving the channels one by one would turn gray into olive; in HSV an achromatic colour stays achromatic.
    """
    hue, saturation, value = colorsys.rgb_to_hsv(*(channel / 255 for channel in color))
    hue += rng.uniform(-_HUE_JITTER, _HUE_JITTER)
    value += rng.uniform(-_JITTER, _JITTER) / 255
    if saturation > 0:
        saturation += rng.uniform(-_JITTER, _JITTER) / 255
    red, green, blue = colorsys.hsv_to_rgb(hue % 1, min(max(saturation, 0), 1), min(max(value, 0), 1))
    return round(red * 255), round(green * 255), round(blue * 255)


def darker(color: RGB) -> RGB:
    """Return the same hue with 60 % of the light."""
    red, green, blue = color
    return red * 6 // 10, green * 6 // 10, blue * 6 // 10


def lightness(color: RGB) -> float:
    """Return the perceived lightness (Rec. 601 luma), 0 to 255."""
    red, green, blue = color
    return 0.299 * red + 0.587 * green + 0.114 * blue


def background_for(ink: RGB, rng: np.random.Generator, contrast: float = INK_CONTRAST) -> RGB:
    """Draw a pale, faintly tinted background at least `contrast` levels lighter or darker than `ink`."""
    while True:
        tinted = rng.uniform(*_BACKGROUND_LIGHTNESS) + rng.uniform(-_TINT, _TINT, size=3)
        red, green, blue = (int(channel) for channel in np.clip(np.rint(tinted), 0, 255))
        if abs(lightness((red, green, blue)) - lightness(ink)) >= contrast:
            return red, green, blue


_LEAST_LIGHTNESS = 110
"""Least lightness of a background: dark edges must stand out from it."""


def hued_background(ink: RGB, rng: np.random.Generator, contrast: float = INK_CONTRAST) -> RGB:
    """Draw a background of any hue, pale to vivid, at least `contrast` levels lighter or darker than `ink`."""
    while True:
        shade = colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0, 0.9), rng.uniform(0.5, 1))
        red, green, blue = (round(255 * channel) for channel in shade)
        color = red, green, blue
        if lightness(color) >= _LEAST_LIGHTNESS and abs(lightness(color) - lightness(ink)) >= contrast:
            return color


def on_hues[T: Any](first: T, second: T, rng: np.random.Generator) -> tuple[T, T]:
    """Return the two tiles on backgrounds of any hue, from which each tile's `ink` stands out.

    The backgrounds are drawn after both tiles, whose pale backgrounds stay in the stream of `rng`: suite 2.0.0 is
    drawn in this order.
    """
    return (
        replace(first, background=hued_background(first.ink, rng)),
        replace(second, background=hued_background(second.ink, rng)),
    )


# -- the canvas --------------------------------------------------------------------------------------------------


TILE_PIXELS = 256
_SUPERSAMPLING = 3
_DRAWN_PIXELS = TILE_PIXELS * _SUPERSAMPLING
FULL_DISK = (0.8, 0.89)  # scales for a drawing that fills the unit disk
_FONT_PIXELS = 160
_BOLDNESS = 7  # pixels of that

Points = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """The place of a drawing on its tile; it carries no meaning.

    Attributes:
        scale: Radius of the drawing, in tile units.
        x: Centre of the drawing to the right, in tile units.
        y: Centre of the drawing downwards, in tile units.
        rotation: Turn in degrees.
        mirror: Whether left and right are exchanged.
    """

    scale: float
    x: float
    y: float
    rotation: float
    mirror: bool

    def apply(self, points: Points) -> Points:
        """Return points in drawing units (N, 2) as tile units (N, 2)."""
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
    """Draw a placement for a drawing that is alone on its tile, up to 5 % off centre.

    Args:
        rng: Generator of the placement.
        scales: Range of the radius, in tile units; a drawing that fills the unit disk leaves the tile above
            FULL_DISK.
        turn: Largest turn in degrees.
        mirrored: Whether the drawing may also be mirrored; not where that would change what it shows, as with
            lettering.
    """
    return Placement(
        scale=round(rng.uniform(*scales), 4),
        x=round(rng.uniform(-0.1, 0.1), 4),
        y=round(rng.uniform(-0.1, 0.1), 4),
        rotation=round(rng.uniform(-turn, turn), 2),
        mirror=bool(rng.integers(2)) and mirrored,
    )


def polygon(*corners: tuple[float, float]) -> Points:
    """Return points (N, 2) with these coordinates."""
    return np.array(corners, dtype=np.float64)


def rectangle(left: float, top: float, right: float, bottom: float) -> Points:
    """Return the four corners (4, 2) of an upright rectangle."""
    return polygon((left, top), (right, top), (right, bottom), (left, bottom))


_HALF_SHIRT = ((0.2, -0.7), (0.42, -0.66), (0.92, -0.3), (0.7, 0.04), (0.5, -0.1), (0.5, 0.8))
SHIRT = polygon(*_HALF_SHIRT, *((-x, y) for x, y in reversed(_HALF_SHIRT)))


def ellipse(x: float, y: float, rx: float, ry: float, start: float = 0, end: float = 360) -> Points:
    """Return points (49, 2) along an ellipse from angle `start` to `end` in degrees, 0 to the right, 90 down."""
    angles = np.deg2rad(np.linspace(start, end, 49))
    return np.stack([x + rx * np.cos(angles), y + ry * np.sin(angles)], axis=1)


def tint(mask: Image.Image, color: RGB) -> Image.Image:
    """Return RGBA art of one colour with the grey picture `mask` as its opacity."""
    art = Image.new("RGBA", mask.size, color)
    art.putalpha(mask)
    return art


@cache
def _lettering(text: str) -> Image.Image:
    """Return a text in Pillow's own font, as a grey picture cut to its ink."""
    font = ImageFont.load_default(size=_FONT_PIXELS)
    left, top, right, bottom = font.getbbox(text, stroke_width=_BOLDNESS)
    mask = Image.new("L", (round(right - left), round(bottom - top)))
    ImageDraw.Draw(mask).text((-left, -top), text, fill=255, font=font, stroke_width=_BOLDNESS)
    return mask.crop(mask.getbbox())


class Canvas:
    """One tile that is being drawn."""

    def __init__(self, background: RGB) -> None:
        self._image = Image.new("RGB", (_DRAWN_PIXELS, _DRAWN_PIXELS), background)

    def pen(self, placement: Placement) -> "Pen":
        """Return a pen that draws at `placement`."""
        return Pen(self._image, placement)

    def picture(self) -> Image.Image:
        """Return the finished tile, RGB, 256 by 256 pixels."""
        return self._image.resize((TILE_PIXELS, TILE_PIXELS), Image.Resampling.LANCZOS)


@dataclass(frozen=True, kw_only=True)
class Tile:
    """Everything that one picture is drawn from: plain values, and so a record of it.

    Attributes:
        ink: Colour that stands out from the background.
    """

    ink: RGB
    background: RGB

    def draw(self) -> Image.Image:
        """Draw the picture, RGB; equal tiles give equal pixels."""
        canvas = Canvas(self.background)
        self._paint(canvas)
        return canvas.picture()

    def record(self) -> dict[str, Any]:
        """Return the values that are hashed into the picture's name and stored with its item."""
        return asdict(self)

    def _paint(self, canvas: Canvas) -> None:
        raise NotImplementedError


class Pen:
    """A pen that draws in drawing units at one placement."""

    def __init__(self, image: Image.Image, placement: Placement) -> None:
        self._image = image
        self._draw = ImageDraw.Draw(image)
        self._placement = placement

    def fill(self, points: Points, color: RGB) -> None:
        """Draw a filled polygon with corners `points` (N, 2)."""
        self._draw.polygon(self._pixels(points), fill=color)

    def line(self, points: Points, color: RGB, width: float) -> None:
        """Draw an open line through `points` (N, 2) with round ends; `width` in drawing units."""
        pixels = self._pixels(points)
        stroke = width * self._placement.scale * _DRAWN_PIXELS / 2
        self._draw.line(pixels, fill=color, width=round(stroke), joint="curve")
        for x, y in (pixels[0], pixels[-1]):
            self._draw.circle((x, y), stroke / 2, fill=color)

    def outline(self, points: Points, color: RGB, width: float) -> None:
        """Draw a closed line around the polygon `points` (N, 2); `width` in drawing units."""
        self.line(np.vstack([points, points[:1]]), color, width)

    def stamp(self, art: Image.Image, x: float, y: float, height: float) -> None:
        """Paste ready-made RGBA art with its centre at (x, y); `height` in drawing units, the width follows."""
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
        """Draw bold lettering with its centre at (x, y); `height` of a capital letter in drawing units."""
        self.stamp(tint(_lettering(text), color), x, y, height)

    def _pixels(self, points: Points) -> list[tuple[float, float]]:
        pixels = (self._placement.apply(points) + 1) * _DRAWN_PIXELS / 2
        return [(x, y) for x, y in pixels.tolist()]


# -- icons -------------------------------------------------------------------------------------------------------


FOLDER = Path(__file__).parents[1] / "art"
CELL_PIXELS = 128
COLUMNS = 12


def color_icon(name: str) -> Image.Image:
    """Return a Fluent icon, RGBA, 128 px square."""
    return _cell("fluent", name)


def mask_icon(name: str) -> Image.Image:
    """Return a Material icon as opacity, grey, 128 px square."""
    return _cell("material", name)


@cache
def mean_color(name: str) -> RGB:
    """Return the average colour of the opaque part of a Fluent icon."""
    pixels = np.asarray(color_icon(name), np.float64).reshape(-1, 4)
    red, green, blue = np.average(pixels[:, :3], axis=0, weights=pixels[:, 3])
    return round(red), round(green), round(blue)


@cache
def _cell(sheet: str, name: str) -> Image.Image:
    row, column = divmod(_index()[sheet].index(name), COLUMNS)
    x, y = column * CELL_PIXELS, row * CELL_PIXELS
    return _sheet(sheet).crop((x, y, x + CELL_PIXELS, y + CELL_PIXELS))


@cache
def _index() -> dict[str, Any]:
    index: dict[str, Any] = json.loads((FOLDER / "index.json").read_text(encoding="utf-8"))
    return index


@cache
def _sheet(name: str) -> Image.Image:
    return stored_picture(FOLDER / f"{name}.png", "RGBA" if name == "fluent" else "L")
