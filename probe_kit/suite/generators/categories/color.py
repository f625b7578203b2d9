"""Color: "red shape" against a shape of another basic colour, of the same outline in half of the pairs.

Backgrounds have a basic colour too, none of the two that meet, and shapes are small and anywhere on their tile.
An untrained conjunction of pixels and words so decodes less.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from probe_kit.suite.generators.canvas import Placement
from probe_kit.suite.generators.generator import Concept, Generator
from probe_kit.suite.generators.outlines import OUTLINES, Figure, colored_outline, random_figure
from probe_kit.suite.generators.palette import COLORS, INK_CONTRAST, RGB, jittered, lightness

_SHRUNK = (0.5, 0.75)
"""Of the size of a drawing; half a tile is legible for a plain outline."""
_REACH = 0.97


def _tiles(left: Concept, right: Concept, rng: np.random.Generator) -> tuple[Figure, Figure]:
    left_outline, right_outline = rng.choice(list(OUTLINES), size=2, replace=False)
    if rng.integers(2):
        right_outline = left_outline
    drawn = (
        random_figure(left.name, str(left_outline), "edged", rng),
        random_figure(right.name, str(right_outline), "edged", rng),
    )
    # After both, whose own backgrounds and places stay in the stream of `rng`: suite 2.0.0 is drawn in this order.
    first, second = (_among_colors(figure, (left, right), rng) for figure in drawn)
    return first, second


def _among_colors(figure: Figure, concepts: Sequence[Concept], rng: np.random.Generator) -> Figure:
    background = other_color(concepts, figure.ink, rng)
    return replace(figure, background=background, placement=moved(figure.placement, rng))


def other_color(concepts: Sequence[Concept], ink: RGB, rng: np.random.Generator) -> RGB:
    """A background of a basic colour that is none of the two that meet, and apart from the `ink`."""
    names = [name for name in COLORS if name not in {concept.name for concept in concepts}]
    while True:
        color = jittered(COLORS[str(rng.choice(names))], rng)
        if abs(lightness(color) - lightness(ink)) >= INK_CONTRAST:
            return color


def moved(placement: Placement, rng: np.random.Generator) -> Placement:
    """Smaller, and anywhere on the tile."""
    scale = round(placement.scale * rng.uniform(*_SHRUNK), 4)
    reach = _REACH - scale
    x, y = rng.uniform(-reach, reach, size=2).round(4).tolist()
    return replace(placement, scale=scale, x=x, y=y)


COLOR = Generator(
    category="color",
    pairs=tuple(combinations([Concept(name, f"{name} shape") for name in COLORS], 2)),
    tiles=_tiles,
    name_of=colored_outline,
)
