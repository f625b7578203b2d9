"""Backgrounds of any hue, so that pixels recur less from picture to picture.

Concepts recur in other pictures, so a probe can learn by itself which pixels answer which word (see the control
`random-features`). What recurs should be the concept and little else: the background has any hue, and where size
means nothing, drawings have other sizes anywhere on their tile.
"""

import colorsys
from dataclasses import replace
from typing import Any

import numpy as np

from probe_kit.suite.generators.drawing.palette import INK_CONTRAST, RGB, lightness

_LEAST_LIGHTNESS = 110
"""Of a background: dark edges must stand out from it."""


def hued_background(ink: RGB, rng: np.random.Generator, contrast: float = INK_CONTRAST) -> RGB:
    """A background of any hue, from pale to vivid, at least `contrast` levels lighter or darker than `ink`."""
    while True:
        shade = colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0, 0.9), rng.uniform(0.5, 1))
        red, green, blue = (round(255 * channel) for channel in shade)
        found = red, green, blue
        if lightness(found) >= _LEAST_LIGHTNESS and abs(lightness(found) - lightness(ink)) >= contrast:
            return found


def on_hues[T: Any](one: T, other: T, rng: np.random.Generator) -> tuple[T, T]:
    """The two tiles on backgrounds of any hue, from which each tile's `ink` stands out.

    Drawn after both tiles, whose pale backgrounds stay in the stream of `rng`: suite 2.0.0 is drawn in this order.
    """
    return (
        replace(one, background=hued_background(one.ink, rng)),
        replace(other, background=hued_background(other.ink, rng)),
    )
