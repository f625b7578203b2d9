"""The eleven basic colour terms, and backgrounds that let a colour stand out."""

import colorsys

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
