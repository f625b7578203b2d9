"""Traffic: "no entry sign" against another road sign, of the same family in half of the pairs.

The names hold no side words: signs that turn left or right are not in this suite.
"""

from dataclasses import dataclass

import numpy as np
from PIL import Image

from probe_kit.suite.generators.backgrounds import on_hues
from probe_kit.suite.generators.drawing.canvas import FULL_DISK, Canvas, Placement, random_placement
from probe_kit.suite.generators.drawing.palette import RGB, background_for
from probe_kit.suite.generators.drawing.road_signs import LOOK_ALIKES, ROAD_SIGNS
from probe_kit.suite.generators.generator import Concept, Generator
from probe_kit.suite.generators.pairing import half_within, none_alike


@dataclass(frozen=True)
class SignPost:
    """Everything the picture is drawn from; `ink` is the colour of the sign's edge."""

    sign: str
    ink: RGB
    background: RGB
    placement: Placement

    def draw(self) -> Image.Image:
        """The tile, RGB."""
        canvas = Canvas(self.background)
        ROAD_SIGNS[self.sign].draw(canvas.pen(self.placement))
        return canvas.picture()


def _sign_post(concept: Concept, rng: np.random.Generator) -> SignPost:
    ink = ROAD_SIGNS[concept.name].edge
    placement = random_placement(rng, FULL_DISK, turn=8, mirrored=False)
    return SignPost(concept.name, ink, background_for(ink, rng), placement)


def _tiles(left: Concept, right: Concept, rng: np.random.Generator) -> tuple[SignPost, SignPost]:
    return on_hues(_sign_post(left, rng), _sign_post(right, rng), rng)


TRAFFIC = Generator(
    category="traffic",
    pairs=half_within(
        [Concept(name, f"{name} sign") for name in ROAD_SIGNS],
        family=lambda concept: ROAD_SIGNS[concept.name].family,
        allowed=none_alike(LOOK_ALIKES),
    ),
    tiles=_tiles,
)
