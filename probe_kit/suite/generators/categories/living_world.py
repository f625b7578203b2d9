"""Living World: "picture of the fox" against another animal or plant, "living thing" against a thing."""

from dataclasses import dataclass

import numpy as np
from PIL import Image

from probe_kit.suite.generators.drawing.art import color_icon, mean_color
from probe_kit.suite.generators.drawing.canvas import Canvas, Placement, random_placement
from probe_kit.suite.generators.drawing.creatures import CREATURES, LOOK_ALIKES, THINGS, Creature
from probe_kit.suite.generators.drawing.palette import RGB, background_for
from probe_kit.suite.generators.generator import Concept, Generator
from probe_kit.suite.generators.pairing import half_within, none_alike, spread_pairs

_ICON_HEIGHT = 1.6  # turned by 8 degrees and moved by 5 %, its corners stay on the tile
_TURN = 8
_ALIVE_SHARE = 6  # one pair in six asks for what is alive or not


@dataclass(frozen=True)
class Depicted(Concept):
    """What an icon shows."""

    icon: str = ""


@dataclass(frozen=True)
class Portrait:
    """Everything the picture is drawn from: one icon; `ink` is its average colour."""

    icon: str
    ink: RGB
    background: RGB
    placement: Placement

    def draw(self) -> Image.Image:
        """The tile, RGB."""
        canvas = Canvas(self.background)
        canvas.pen(self.placement).stamp(color_icon(self.icon), 0, 0, _ICON_HEIGHT)
        return canvas.picture()


def _portrait(concept: Depicted, rng: np.random.Generator) -> Portrait:
    ink = mean_color(concept.icon)
    return Portrait(concept.icon, ink, background_for(ink, rng), random_placement(rng, (0.9, 1.0), turn=_TURN))


def _tiles(left: Depicted, right: Depicted, rng: np.random.Generator) -> tuple[Portrait, Portrait]:
    return _portrait(left, rng), _portrait(right, rng)


def _named() -> tuple[tuple[Depicted, Depicted], ...]:
    """Half of the pairs inside one family; never a whole animal beside a mere face."""
    creature_of = {creature.name: creature for creature in CREATURES}
    unlike = none_alike(LOOK_ALIKES)

    def creature(concept: Depicted) -> Creature:
        return creature_of[concept.name]

    return half_within(
        [Depicted(c.name, f"picture of the {c.name}", icon=c.icon) for c in CREATURES],
        family=lambda concept: creature(concept).family,
        allowed=lambda a, b: creature(a).view == creature(b).view and unlike(a, b),
    )


def _alive_or_not(count: int) -> tuple[tuple[Depicted, Depicted], ...]:
    """A living thing beside one that is not; every creature and every thing about equally often."""
    living = [Depicted("living thing", "living thing", icon=c.icon) for c in CREATURES]
    dead = [Depicted("thing that is not alive", "thing that is not alive", icon=icon) for icon in THINGS]
    return spread_pairs(living + dead, lambda a, b: a.name != b.name, most=count)


_NAMED = _named()
LIVING_WORLD = Generator(
    category="living-world",
    pairs=_NAMED + _alive_or_not(len(_NAMED) // (_ALIVE_SHARE - 1)),
    tiles=_tiles,
)
