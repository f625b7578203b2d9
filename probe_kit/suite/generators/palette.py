"""The eleven basic colour terms, and backgrounds that let a colour stand out.

Concepts recur in other pictures, so a probe can learn by itself which pixels answer which word (see the control
`random-features`). What recurs should be the concept and little else: the background has any hue, and where size
means nothing, drawings have other sizes anywhere on their tile.
"""

import colorsys
from dataclasses import replace
from typing import Any

import numpy as np

RGB = tuple[int, int, int]

COLORS: dict[str, RGB] = {
    "black": (20, 20, 20),
    "white": (248, 248, 248),
    "gray": (128, 128, 128),
    "red": (214, 30, 34),
    "green": (30, 150, 56),
    "blue": (34, 82, 214),
    "yellow": (252, 224, 36),
    "orange": (245, 130, 18),
    "brown": (118, 70, 32),
    "pink": (248, 138, 192),
    "purple": (122, 46, 176),
}

INK_CONTRAST = 40
_JITTER = 14
_HUE_JITTER = 5 / 360
_BACKGROUND_LIGHTNESS = (150, 246)
_TINT = 12


def jittered(color: RGB, rng: np.random.Generator) -> RGB:
    """A shade that still has the same name: up to 14 levels off, and 5 degrees in hue.

    Moving the channels one by one would turn gray into olive; in HSV an achromatic colour stays achromatic.
    """
    hue, saturation, value = colorsys.rgb_to_hsv(*(channel / 255 for channel in color))
    hue += rng.uniform(-_HUE_JITTER, _HUE_JITTER)
    value += rng.uniform(-_JITTER, _JITTER) / 255
    if saturation > 0:
        saturation += rng.uniform(-_JITTER, _JITTER) / 255
    red, green, blue = colorsys.hsv_to_rgb(hue % 1, min(max(saturation, 0), 1), min(max(value, 0), 1))
    return round(red * 255), round(green * 255), round(blue * 255)


def darker(color: RGB) -> RGB:
    """The same hue with 60 % of the light."""
    red, green, blue = color
    return red * 6 // 10, green * 6 // 10, blue * 6 // 10


def lightness(color: RGB) -> float:
    """Perceived lightness (Rec. 601 luma), 0 to 255."""
    red, green, blue = color
    return 0.299 * red + 0.587 * green + 0.114 * blue


def background_for(ink: RGB, rng: np.random.Generator, contrast: float = INK_CONTRAST) -> RGB:
    """A pale, faintly tinted background at least `contrast` levels lighter or darker than `ink`."""
    while True:
        tinted = rng.uniform(*_BACKGROUND_LIGHTNESS) + rng.uniform(-_TINT, _TINT, size=3)
        red, green, blue = (int(channel) for channel in np.clip(np.rint(tinted), 0, 255))
        if abs(lightness((red, green, blue)) - lightness(ink)) >= contrast:
            return red, green, blue


_LEAST_LIGHTNESS = 110
"""Of a background: dark edges must stand out from it."""


def hued_background(ink: RGB, rng: np.random.Generator, contrast: float = INK_CONTRAST) -> RGB:
    """A background of any hue, from pale to vivid, at least `contrast` levels lighter or darker than `ink`."""
    while True:
        shade = colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0, 0.9), rng.uniform(0.5, 1))
        red, green, blue = (round(255 * channel) for channel in shade)
        color = red, green, blue
        if lightness(color) >= _LEAST_LIGHTNESS and abs(lightness(color) - lightness(ink)) >= contrast:
            return color


def on_hues[T: Any](first: T, second: T, rng: np.random.Generator) -> tuple[T, T]:
    """The two tiles on backgrounds of any hue, from which each tile's `ink` stands out.

    Drawn after both tiles, whose pale backgrounds stay in the stream of `rng`: suite 2.0.0 is drawn in this order.
    """
    return (
        replace(first, background=hued_background(first.ink, rng)),
        replace(second, background=hued_background(second.ink, rng)),
    )
