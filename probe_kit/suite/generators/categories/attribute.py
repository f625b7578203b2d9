"""Attribute: "longer pencil" and "shorter pencil", asked of the same two pencils."""

import colorsys
from dataclasses import dataclass

import numpy as np
from PIL import Image

from probe_kit.suite.generators.backgrounds import on_hues
from probe_kit.suite.generators.drawing.canvas import Canvas, Placement, random_placement
from probe_kit.suite.generators.drawing.gradable import GRADABLES, Gradable
from probe_kit.suite.generators.drawing.palette import COLORS, RGB, background_for, jittered
from probe_kit.suite.generators.generator import Concept, Generator

_GAP = (0.45, 0.6)  # between the two levels; a smaller one vanishes on the far tile
_SCALES = (0.84, 0.89)  # so little that a smaller scale never looks like a smaller thing
_INKS = ("red", "green", "blue", "orange", "brown", "purple", "gray")
_LIGHTEST, _DARKEST = 0.95, 0.2  # value of a shaded thing
_THINGS = {name: thing for thing in GRADABLES for name in (thing.more, thing.less)}


@dataclass(frozen=True)
class Sample:
    """Everything the picture is drawn from: a thing, named by its more, with this much of its property."""

    thing: str
    level: float
    ink: RGB
    background: RGB
    placement: Placement

    def draw(self) -> Image.Image:
        """The tile, RGB."""
        canvas = Canvas(self.background)
        _THINGS[self.thing].draw(canvas.pen(self.placement), self.level, self.ink)
        return canvas.picture()


def _sample(thing: Gradable, level: float, rng: np.random.Generator) -> Sample:
    color = COLORS[str(rng.choice(_INKS))]
    ink = _shade(level, rng) if thing.shaded else jittered(color, rng)
    placement = random_placement(rng, _SCALES, turn=2 if thing.upright else 10)
    return Sample(thing.more, round(level, 3), ink, background_for(ink, rng), placement)


def _shade(level: float, rng: np.random.Generator) -> RGB:
    """Any hue, as dark as the level says."""
    value = _LIGHTEST + level * (_DARKEST - _LIGHTEST)
    red, green, blue = colorsys.hsv_to_rgb(rng.uniform(), 0.35, value)
    return round(255 * red), round(255 * green), round(255 * blue)


def _tiles(left: Concept, right: Concept, rng: np.random.Generator) -> tuple[Sample, Sample]:
    """Two levels a good way apart, wherever in the range."""
    gap = rng.uniform(*_GAP)
    low = rng.uniform(0, 1 - gap)
    levels = {"neg": low, "pos": low + gap}
    one, other = (_sample(_THINGS[c.name], float(levels[c.polarity]), rng) for c in (left, right))
    return on_hues(one, other, rng)


ATTRIBUTE = Generator(
    category="attribute",
    pairs=tuple(
        (Concept(thing.more, thing.more, "pos"), Concept(thing.less, thing.less, "neg")) for thing in GRADABLES
    ),
    tiles=_tiles,
)
