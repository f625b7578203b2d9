"""Symmetry: "symmetric shape" against an asymmetric one of the same kind, and vice versa.

Both are polygons around an axis, with as many corners and as much area on either side of it; in the asymmetric
one the half widths of one side have changed places. Measured on its pixels, each is clearly what it is called.
"""

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageChops, ImageDraw, ImageStat

from probe_kit.suite.generators.canvas import Canvas, Placement, Points, Tile, random_placement
from probe_kit.suite.generators.generator import Concept, Generator
from probe_kit.suite.generators.palette import COLORS, RGB, background_for, jittered

_MOST_OVERLAP = 0.78  # of an asymmetric shape with its best mirror image, or with itself upside down
_EDGE: RGB = (38, 38, 38)
_EDGE_WIDTH = 0.03
_RADIUS = 0.86
_CORNERS = (4, 7)  # half widths per side, from and below
_WIDTHS = (0.22, 0.95)
_MASK_PIXELS = 128


@dataclass(frozen=True)
class Outline(Tile):
    """Everything the picture is drawn from; the widths run along the axis, one list for each of its sides."""

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
        pen.outline(corners, _EDGE, _EDGE_WIDTH)


def _corners(one_side: tuple[float, ...], other_side: tuple[float, ...]) -> Points:
    """The polygon (2 N, 2) around an upright axis, scaled into the unit disk."""
    heights = np.linspace(-1, 1, len(one_side))
    points = np.vstack(
        [np.stack([one_side, heights], axis=1), np.stack([np.negative(other_side), heights], axis=1)[::-1]]
    )
    scaled: Points = points * (_RADIUS / np.linalg.norm(points, axis=1).max())
    return scaled


def mirror_overlap(one_side: tuple[float, ...], other_side: tuple[float, ...]) -> float:
    """Shared area over joint area of the shape and its best mirror image, over all axes through its centre.

    Turned by half a turn counts as well: a shape like the letter S would be called symmetric by many.
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
    """Half widths of both sides; drawn again until the pixels agree with the name."""
    while True:
        count = int(rng.integers(*_CORNERS))
        widths = tuple(rng.uniform(*_WIDTHS, size=count).round(3).tolist())
        if symmetric:
            return widths, widths
        shift = int(rng.integers(1, count))
        shifted = widths[shift:] + widths[:shift]
        if mirror_overlap(widths, shifted) <= _MOST_OVERLAP:
            return widths, shifted


def _outline(concept: Concept, rng: np.random.Generator) -> Outline:
    color = str(rng.choice(list(COLORS)))
    ink = jittered(COLORS[color], rng)
    left_widths, right_widths = _sides(concept.name == "symmetric", rng)
    placement = random_placement(rng, (0.88, 1.0), turn=7)
    lying = bool(rng.integers(2))
    return Outline(
        color, left_widths, right_widths, lying, placement, ink=ink, background=background_for(ink, rng)
    )


def _tiles(left: Concept, right: Concept, rng: np.random.Generator) -> tuple[Outline, Outline]:
    return _outline(left, rng), _outline(right, rng)


SYMMETRY = Generator(
    category="symmetry",
    pairs=((Concept("symmetric", "symmetric shape", "pos"), Concept("asymmetric", "asymmetric shape", "neg")),),
    tiles=_tiles,
)
