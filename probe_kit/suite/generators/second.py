"""Version 2 of the suite: the concepts and words of version 1, drawn so that pixels recur less.

Concepts recur in other pictures, so a probe can learn by itself which pixels answer which word (see the control
`random-features`). What recurs here is the concept and little else: backgrounds of any hue instead of pale grey
ones, and where size means nothing, drawings of other sizes anywhere on their tile. No word is new, as a policy
may know no others.
"""

import colorsys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from probe_kit.suite.generators.categories.attribute import ATTRIBUTE
from probe_kit.suite.generators.categories.color import COLOR
from probe_kit.suite.generators.categories.shape import SHAPE
from probe_kit.suite.generators.categories.traffic import TRAFFIC
from probe_kit.suite.generators.drawing.canvas import Placement
from probe_kit.suite.generators.drawing.figure import Figure
from probe_kit.suite.generators.drawing.palette import COLORS, INK_CONTRAST, RGB, jittered, lightness
from probe_kit.suite.generators.generator import Concept, Generator

_LEAST_LIGHTNESS = 110
"""Of a background: dark edges must stand out from it."""
_SHRUNK = (0.5, 0.75)
"""Of the size in version 1; half a tile is legible for a plain outline."""
_REACH = 0.97


def hued_background(ink: RGB, rng: np.random.Generator, contrast: float = INK_CONTRAST) -> RGB:
    """A background of any hue, from pale to vivid, at least `contrast` levels lighter or darker than `ink`."""
    while True:
        shade = colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0, 0.9), rng.uniform(0.5, 1))
        red, green, blue = (round(255 * channel) for channel in shade)
        found = red, green, blue
        if lightness(found) >= _LEAST_LIGHTNESS and abs(lightness(found) - lightness(ink)) >= contrast:
            return found


def other_color(concepts: Sequence[Concept], ink: RGB, rng: np.random.Generator) -> RGB:
    """A background of a basic colour that is none of the two that meet, and apart from the `ink`."""
    names = [name for name in COLORS if name not in {concept.name for concept in concepts}]
    while True:
        found = jittered(COLORS[str(rng.choice(names))], rng)
        if abs(lightness(found) - lightness(ink)) >= INK_CONTRAST:
            return found


def moved(placement: Placement, rng: np.random.Generator) -> Placement:
    """Smaller, and anywhere on the tile."""
    scale = round(placement.scale * rng.uniform(*_SHRUNK), 4)
    reach = _REACH - scale
    x, y = rng.uniform(-reach, reach, size=2).round(4).tolist()
    return replace(placement, scale=scale, x=x, y=y)


def _colors(left: Concept, right: Concept, rng: np.random.Generator) -> tuple[Figure, Figure]:
    drawn: tuple[Any, Any] = COLOR.tiles(left, right, rng)
    one, other = (_color(figure, (left, right), rng) for figure in drawn)
    return one, other


def _color(figure: Figure, concepts: Sequence[Concept], rng: np.random.Generator) -> Figure:
    background = other_color(concepts, figure.ink, rng)
    return replace(figure, background=background, placement=moved(figure.placement, rng))


def _hued(generator: Generator[Any]) -> Generator[Any]:
    """The same drawings on backgrounds of any hue, from which each tile's `ink` stands out."""

    def tiles(left: Concept, right: Concept, rng: np.random.Generator) -> tuple[Any, Any]:
        drawn: tuple[Any, Any] = generator.tiles(left, right, rng)
        one, other = (replace(tile, background=hued_background(tile.ink, rng)) for tile in drawn)
        return one, other

    return replace(generator, tiles=tiles)


SECOND: tuple[Generator[Any], ...] = (replace(COLOR, tiles=_colors), *map(_hued, (ATTRIBUTE, SHAPE, TRAFFIC)))
"""What version 2 draws anew; the other categories leave nothing to take away, and stay."""
