"""Color, Shape and Symmetry: pictures of one outline.

Color asks for "red shape" against a shape of another basic colour, of the same outline in half of the pairs.
Backgrounds have a basic colour too, none of the two that meet, and shapes are small and anywhere on their tile. An
untrained conjunction of pixels and words so decodes less.

Shape asks for "triangle" against another outline. The fifteen outlines are polygons of equal area, so that the
area of ink does not identify the outline.

Symmetry asks for "symmetric shape" against an asymmetric one of the same kind, and vice versa. Both are polygons
around an axis, with as many corners and as much area on either side of it. In the asymmetric one, the half widths
of one side have changed places. Measured on its pixels, each clearly matches its name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from PIL import Image, ImageChops, ImageDraw, ImageStat

from probe_kit.suite.generators.drawing import (
    COLORS,
    INK_CONTRAST,
    RGB,
    Canvas,
    Placement,
    Points,
    Tile,
    background_for,
    ellipse,
    jitter,
    lightness,
    polygon,
    random_placement,
)
from probe_kit.suite.generators.generator import Concept, Generator, each, each_on_hues, none_alike

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


def _match_area(points: Points) -> Points:
    """Return the same outline with the shared area and its bounding box centred on the origin."""
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
OUTLINES: dict[str, Points] = {name: _match_area(points) for name, points in _DRAWN.items()}


# -- figures -----------------------------------------------------------------------------------------------------


# edged: filled, with a thin dark edge; plain: filled; hollow: a thick line only
Style = Literal["edged", "plain", "hollow"]

_EDGE = (38, 38, 38)
_EDGE_WIDTH = 0.025
_HOLLOW_WIDTH = 0.15


@dataclass(frozen=True)
class Figure(Tile):
    """Everything that the picture is drawn from."""

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
    """Return the figure in words, such as "red circle"."""
    return f"{figure.color} {figure.outline}"


def random_figure(color: str, outline: str, style: Style, rng: np.random.Generator) -> Figure:
    """Draw a figure of this colour and outline with everything else from `rng`."""
    ink = jitter(COLORS[color], rng)
    background = background_for(ink, rng)
    return Figure(color, outline, style, random_placement(rng), ink=ink, background=background)


# -- Color -------------------------------------------------------------------------------------------------------


_SHRUNK = (0.5, 0.75)
"""Range of the factor by which a drawing is made smaller; half a tile is legible for a plain outline."""
_REACH = 0.97


def _colored_tiles(left: Concept, right: Concept, rng: np.random.Generator) -> tuple[Figure, Figure]:
    left_outline, right_outline = rng.choice(list(OUTLINES), size=2, replace=False)
    if rng.integers(2):
        right_outline = left_outline
    drawn = (
        random_figure(left.name, str(left_outline), "edged", rng),
        random_figure(right.name, str(right_outline), "edged", rng),
    )
    # After both, whose own backgrounds and places stay in the stream of `rng`: suite 2.0.0 is drawn in this order.
    first, second = (
        replace(
            figure,
            background=other_color((left, right), figure.ink, rng),
            placement=move_placement(figure.placement, rng),
        )
        for figure in drawn
    )
    return first, second


def other_color(concepts: Sequence[Concept], ink: RGB, rng: np.random.Generator) -> RGB:
    """Draw a background of a basic colour that is none of the two that meet, and apart from the `ink`."""
    names = [name for name in COLORS if name not in {concept.name for concept in concepts}]
    while True:
        color = jitter(COLORS[str(rng.choice(names))], rng)
        if abs(lightness(color) - lightness(ink)) >= INK_CONTRAST:
            return color


def move_placement(placement: Placement, rng: np.random.Generator) -> Placement:
    """Return a smaller placement, anywhere on the tile."""
    scale = round(placement.scale * rng.uniform(*_SHRUNK), 4)
    reach = _REACH - scale
    x, y = rng.uniform(-reach, reach, size=2).round(4).tolist()
    return replace(placement, scale=scale, x=x, y=y)


COLOR = Generator(
    category="color",
    pairs=tuple(combinations([Concept(name, f"{name} shape") for name in COLORS], 2)),
    tiles=_colored_tiles,
    name_of=colored_outline,
)


# -- Shape -------------------------------------------------------------------------------------------------------


_HOLLOW_SHARE = 0.3
_CONFUSABLE = (
    {"square", "rectangle", "diamond", "parallelogram"},
    {"trapezoid", "rectangle", "parallelogram"},
    {"circle", "oval"},
    {"pentagon", "hexagon"},
)

# "right triangle" can be drawn but not asked for: its name holds a side word.
_NAMES = [name for name in OUTLINES if name != "right triangle"]


def _figure(concept: Concept, rng: np.random.Generator) -> Figure:
    color = str(rng.choice(list(COLORS)))
    return random_figure(color, concept.name, "hollow" if rng.random() < _HOLLOW_SHARE else "plain", rng)


SHAPE = Generator(
    category="shape",
    pairs=tuple(
        (first, second)
        for first, second in combinations([Concept(name, name) for name in _NAMES], 2)
        if none_alike(_CONFUSABLE)(first, second)
    ),
    tiles=each_on_hues(_figure),
    name_of=colored_outline,
)


# -- Symmetry ----------------------------------------------------------------------------------------------------


_MOST_OVERLAP = 0.78  # of an asymmetric shape with its best mirror image, or with itself upside down
_SYMMETRY_EDGE_WIDTH = 0.03
_RADIUS = 0.86
_CORNERS = (4, 7)  # half widths per side, from and below
_WIDTHS = (0.22, 0.95)
_MASK_PIXELS = 128


@dataclass(frozen=True)
class ShapeOutline(Tile):
    """Everything that the picture is drawn from; the widths run along the axis, one list for each of its sides."""

    color: str
    one_side: tuple[float, ...]
    other_side: tuple[float, ...]
    lying: bool
    placement: Placement

    def _paint(self, canvas: Canvas) -> None:
        pen = canvas.pen(self.placement)
        corners = _corners(self.one_side, self.other_side)
        if self.lying:
            corners = corners[:, ::-1]
        pen.fill(corners, self.ink)
        pen.outline(corners, _EDGE, _SYMMETRY_EDGE_WIDTH)


def _corners(one_side: tuple[float, ...], other_side: tuple[float, ...]) -> Points:
    """Return the polygon (2 N, 2) around an upright axis, scaled into the unit disk."""
    heights = np.linspace(-1, 1, len(one_side))
    points = np.vstack(
        [np.stack([one_side, heights], axis=1), np.stack([np.negative(other_side), heights], axis=1)[::-1]]
    )
    scaled: Points = points * (_RADIUS / np.linalg.norm(points, axis=1).max())
    return scaled


def mirror_overlap(one_side: tuple[float, ...], other_side: tuple[float, ...]) -> float:
    """Return the shared area over the joint area of the shape and its best mirror image.

    All axes through its centre are tried. A half turn counts as well: many would call a shape like the letter S
    symmetric.
    """
    mask = Image.new("L", (_MASK_PIXELS, _MASK_PIXELS))
    corners = _corners(one_side, other_side)
    centred = corners - (corners.max(axis=0) + corners.min(axis=0)) / 2
    pixels = (centred + 1) * _MASK_PIXELS / 2
    ImageDraw.Draw(mask).polygon([(x, y) for x, y in pixels.tolist()], fill=255)
    mirrored = mask.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    images = [mirrored.rotate(angle) for angle in range(0, 360, 15)]
    return max(_overlap(mask, image) for image in (*images, mask.rotate(180)))


def _overlap(first: Image.Image, second: Image.Image) -> float:
    shared = ImageStat.Stat(ImageChops.darker(first, second)).sum[0]
    return float(shared / ImageStat.Stat(ImageChops.lighter(first, second)).sum[0])


def _sides(symmetric: bool, rng: np.random.Generator) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Draw the half widths of both sides; again until the pixels agree with the name."""
    while True:
        count = int(rng.integers(*_CORNERS))
        widths = tuple(rng.uniform(*_WIDTHS, size=count).round(3).tolist())
        if symmetric:
            return widths, widths
        shift = int(rng.integers(1, count))
        shifted = widths[shift:] + widths[:shift]
        if mirror_overlap(widths, shifted) <= _MOST_OVERLAP:
            return widths, shifted


def _outline(concept: Concept, rng: np.random.Generator) -> ShapeOutline:
    color = str(rng.choice(list(COLORS)))
    ink = jitter(COLORS[color], rng)
    left_widths, right_widths = _sides(concept.name == "symmetric", rng)
    placement = random_placement(rng, (0.88, 1.0), turn=7)
    lying = bool(rng.integers(2))
    return ShapeOutline(
        color, left_widths, right_widths, lying, placement, ink=ink, background=background_for(ink, rng)
    )


SYMMETRY = Generator(
    category="symmetry",
    pairs=((Concept("symmetric", "symmetric shape", "pos"), Concept("asymmetric", "asymmetric shape", "neg")),),
    tiles=each(_outline),
)
