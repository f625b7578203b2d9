"""Emotion: "sad face" against another feeling, and "more smiling person" against less of the same."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from probe_kit.suite.generators.drawing import (
    FULL_DISK,
    RGB,
    Canvas,
    Pen,
    Placement,
    Tile,
    background_for,
    ellipse,
    lightness,
    polygon,
    random_placement,
)
from probe_kit.suite.generators.generator import Concept, Generator, each

SKINS: tuple[RGB, ...] = (
    *((255, 224, 196), (240, 194, 150), (224, 172, 105)),
    *((190, 128, 78), (141, 85, 48), (92, 56, 36)),
)
HAIRS: tuple[RGB, ...] = (
    *((26, 22, 20), (84, 50, 28), (150, 96, 48)),
    *((222, 178, 88), (170, 60, 24), (132, 132, 132)),
)
_DARK: RGB = (26, 20, 18)
_LIGHT: RGB = (252, 240, 222)
_WHITE: RGB = (252, 252, 252)
_LIP: RGB = (150, 30, 40)
_MIDDLE_LIGHTNESS = 120
_MOUTH_Y = 0.5


@dataclass(frozen=True)
class Expression:
    """The settings of a face; each of them is 0 at rest.

    Attributes:
        smile: Corners of the mouth up (1) or down (-1).
        gape: Mouth open, 0 to 1.
        wave: A trembling mouth, 0 to 1.
        frown: Inner ends of the brows down (1) or up (-1).
        lift: Brows up, 0 to 1.
        eyes: Wide open (1), at rest (0), shut (-1).
    """

    smile: float = 0
    gape: float = 0
    wave: float = 0
    frown: float = 0
    lift: float = 0
    eyes: float = 0

    def at(self, strength: float) -> "Expression":
        """Return the same feeling with this strength."""
        return Expression(*(strength * part for part in vars(self).values()))


EXPRESSIONS: dict[str, Expression] = {
    "happy": Expression(smile=1, gape=0.9, lift=0.3),
    "sad": Expression(smile=-1, frown=-1, eyes=-0.35),
    "angry": Expression(smile=-0.55, frown=1.1, gape=0.25, eyes=-0.15),
    "surprised": Expression(gape=1, lift=1, eyes=1),
    "neutral": Expression(),
    "sleepy": Expression(eyes=-1, gape=0.3),
    "scared": Expression(wave=1, frown=-0.8, lift=0.7, eyes=0.9),
}


def draw_head(pen: Pen, skin: RGB, hair: RGB, long_hair: bool) -> None:
    """Draw hair, ears and an empty face in the unit disk."""
    if long_hair:
        pen.fill(ellipse(0, -0.12, 0.88, 0.82, 180, 360), hair)
        for side in (-1, 1):
            strand = polygon((0.88, -0.14), (0.5, -0.14), (0.42, 0.86), (0.78, 0.84))
            pen.fill(strand * np.array([side, 1]), hair)
    for side in (-1, 1):
        pen.fill(ellipse(side * 0.72, 0.06, 0.15, 0.18), skin)
    pen.fill(ellipse(0, 0.06, 0.72, 0.86), skin)
    pen.fill(np.vstack([ellipse(0, -0.12, 0.75, 0.76, 180, 360), ellipse(0, -0.12, 0.72, 0.42, 0, -180)]), hair)


def draw_glasses(pen: Pen, skin: RGB) -> None:
    """Draw round frames around the eyes."""
    color = _standing_out(skin)
    for side in (-1, 1):
        pen.outline(ellipse(side * 0.32, -0.02, 0.27, 0.27), color, 0.045)
    pen.line(polygon((-0.06, -0.04), (0.06, -0.04)), color, 0.045)


def draw_expression(pen: Pen, set_as: Expression, skin: RGB) -> None:
    """Draw eyes, brows and mouth."""
    color = _standing_out(skin)
    for side in (-1, 1):
        _draw_eye(pen, side, set_as.eyes, color)
        inner, outer = 0.13 + 0.02 * abs(set_as.frown), 0.55
        height, slope = -0.34 - 0.15 * set_as.lift, 0.13 * set_as.frown
        pen.line(polygon((side * inner, height + slope), (side * outer, height - slope)), color, 0.1)
    _draw_mouth(pen, set_as, color)


def _draw_eye(pen: Pen, side: int, opening: float, lid: RGB) -> None:
    x, y = side * 0.32, -0.02
    height = 0.14 * (1 + opening) if opening < 0 else 0.14 + 0.07 * opening
    if height < 0.05:
        pen.line(ellipse(x, y - 0.06, 0.19, 0.13, 15, 165), lid, 0.09)
        return
    pen.fill(ellipse(x, y, 0.19, height), _WHITE)
    pupil = min(height, 0.1)
    pen.fill(ellipse(x, y, pupil, pupil), _DARK)
    if opening < -0.1:
        pen.line(polygon((x - 0.2, y - height), (x + 0.2, y - height)), lid, 0.06)


def _draw_mouth(pen: Pen, set_as: Expression, color: RGB) -> None:
    if set_as.smile > 0.05:
        bend = 0.08 + 0.28 * set_as.smile
        lower = ellipse(0, _MOUTH_Y - 0.1 * set_as.smile, 0.4, bend, 0, 180)
        if set_as.gape > 0.5:
            pen.fill(lower, _WHITE)
            pen.outline(lower, color, 0.08)
        else:
            pen.line(lower, color, 0.1)
    elif set_as.smile < -0.05:
        bend = 0.26 * -set_as.smile
        pen.line(ellipse(0, _MOUTH_Y + bend * 0.7, 0.32, bend, 180, 360), color, 0.1)
    elif set_as.wave > 0.05:
        x = np.linspace(-0.36, 0.36, 41)
        wave = _MOUTH_Y + 0.08 * set_as.wave * np.sin(x / 0.36 * 2.5 * np.pi)
        pen.line(np.stack([x, wave], axis=1), color, 0.09)
    elif set_as.gape > 0.05:
        pen.fill(ellipse(0, _MOUTH_Y + 0.02, 0.1 + 0.1 * set_as.gape, 0.06 + 0.2 * set_as.gape), color)
        pen.fill(ellipse(0, _MOUTH_Y + 0.02, 0.04 + 0.1 * set_as.gape, 0.2 * set_as.gape), _LIP)
    else:
        pen.line(polygon((-0.28, _MOUTH_Y), (0.28, _MOUTH_Y)), color, 0.1)


def _standing_out(skin: RGB) -> RGB:
    """Return a colour that is visible on the skin: dark brows vanish on dark skin, light ones on light skin."""
    return _DARK if lightness(skin) > _MIDDLE_LIGHTNESS else _LIGHT


_GLASSES_SHARE = 0.2
_WEAK, _STRONG = 0.3, 1.0
# How more and how less of a feeling is asked for.
_DEGREES = {
    "happy": ("more smiling person", "less smiling person"),
    "sad": ("sadder person", "less sad person"),
    "angry": ("angrier person", "less angry person"),
    "surprised": ("more surprised person", "less surprised person"),
    "sleepy": ("sleepier person", "less sleepy person"),
    "scared": ("more scared person", "less scared person"),
}


@dataclass(frozen=True)
class Feeling(Concept):
    """One emotion, with a strength from 0 for none of it to 1 for all of it."""

    emotion: str = "neutral"
    strength: float = _STRONG


@dataclass(frozen=True)
class Face(Tile):
    """Everything that the picture is drawn from; `ink` is the skin."""

    emotion: str
    strength: float
    hair: RGB
    long_hair: bool
    glasses: bool
    placement: Placement

    def _paint(self, canvas: Canvas) -> None:
        pen = canvas.pen(self.placement)
        draw_head(pen, self.ink, self.hair, self.long_hair)
        if self.glasses:
            draw_glasses(pen, self.ink)
        draw_expression(pen, EXPRESSIONS[self.emotion].at(self.strength), self.ink)


def _face(concept: Feeling, rng: np.random.Generator) -> Face:
    skin = SKINS[int(rng.integers(len(SKINS)))]
    return Face(
        emotion=concept.emotion,
        strength=concept.strength,
        ink=skin,
        hair=HAIRS[int(rng.integers(len(HAIRS)))],
        long_hair=bool(rng.integers(2)),
        glasses=bool(rng.random() < _GLASSES_SHARE),
        background=background_for(skin, rng),
        placement=random_placement(rng, FULL_DISK, turn=8),
    )


EMOTION = Generator(
    category="emotion",
    pairs=(
        *combinations([Feeling(name, f"{name} face", emotion=name) for name in EXPRESSIONS], 2),
        *(
            (
                Feeling(more.removesuffix(" person"), more, "pos", emotion, _STRONG),
                Feeling(less.removesuffix(" person"), less, "neg", emotion, _WEAK),
            )
            for emotion, (more, less) in _DEGREES.items()
        ),
    ),
    tiles=each(_face),
)
