"""State: "open door" and "closed door", asked of the same two doors."""

from dataclasses import dataclass

import numpy as np
from PIL import Image

from probe_kit.suite.generators.drawing.canvas import FULL_DISK, Canvas, Placement, random_placement
from probe_kit.suite.generators.drawing.palette import COLORS, RGB, background_for, jittered
from probe_kit.suite.generators.drawing.two_states import TWO_STATES
from probe_kit.suite.generators.generator import Concept, Generator

_THINGS = {name: thing for thing in TWO_STATES for name in (thing.first, thing.second)}


@dataclass(frozen=True)
class Condition:
    """Everything the picture is drawn from: a thing in the state it is asked for by."""

    state: str
    ink: RGB
    background: RGB
    placement: Placement

    def draw(self) -> Image.Image:
        """The tile, RGB."""
        canvas = Canvas(self.background)
        thing = _THINGS[self.state]
        thing.draw(canvas.pen(self.placement), self.state == thing.first, self.ink)
        return canvas.picture()


def _condition(concept: Concept, rng: np.random.Generator) -> Condition:
    color = str(rng.choice(_THINGS[concept.name].colors))
    ink = jittered(COLORS[color], rng)
    return Condition(concept.name, ink, background_for(ink, rng), random_placement(rng, FULL_DISK, turn=8))


def _tiles(left: Concept, right: Concept, rng: np.random.Generator) -> tuple[Condition, Condition]:
    return _condition(left, rng), _condition(right, rng)


STATE = Generator(
    category="state",
    pairs=tuple(
        (Concept(thing.first, thing.first, "pos"), Concept(thing.second, thing.second, "neg"))
        for thing in TWO_STATES
    ),
    tiles=_tiles,
)
