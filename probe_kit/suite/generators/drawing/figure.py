"""One outline in one colour on a plain background: the picture of Color and of Shape items."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from PIL import Image

from probe_kit.suite.generators.drawing.canvas import Canvas, Placement, random_placement
from probe_kit.suite.generators.drawing.outlines import OUTLINES
from probe_kit.suite.generators.drawing.palette import COLORS, RGB, background_for, jittered

# edged: filled, with a thin dark edge; plain: filled; hollow: a thick line only
Style = Literal["edged", "plain", "hollow"]

_EDGE = (38, 38, 38)
_EDGE_WIDTH = 0.025
_HOLLOW_WIDTH = 0.15


@dataclass(frozen=True)
class Figure:
    """Everything the picture is drawn from."""

    color: str
    outline: str
    style: Style
    ink: RGB
    background: RGB
    placement: Placement

    def draw(self) -> Image.Image:
        """The tile, RGB."""
        canvas = Canvas(self.background)
        pen = canvas.pen(self.placement)
        corners = OUTLINES[self.outline]
        if self.style == "hollow":
            inner = corners * (1 - _HOLLOW_WIDTH / 2)  # half of the line lies outside of its corners
            pen.outline(inner, self.ink, _HOLLOW_WIDTH)
        else:
            pen.fill(corners, self.ink)
        if self.style == "edged":
            pen.outline(corners, _EDGE, _EDGE_WIDTH)
        return canvas.picture()


def colored_outline(figure: Figure) -> str:
    """The figure in words, such as "red circle"."""
    return f"{figure.color} {figure.outline}"


def random_figure(color: str, outline: str, style: Style, rng: np.random.Generator) -> Figure:
    """A figure of this colour and outline with everything else drawn from `rng`."""
    ink = jittered(COLORS[color], rng)
    return Figure(color, outline, style, ink, background_for(ink, rng), random_placement(rng))
