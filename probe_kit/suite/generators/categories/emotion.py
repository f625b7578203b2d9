"""Emotion: "sad face" against another feeling, and "more smiling person" against less of the same."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from PIL import Image

from probe_kit.suite.generators.drawing.canvas import FULL_DISK, Canvas, Placement, random_placement
from probe_kit.suite.generators.drawing.faces import (
    EXPRESSIONS,
    HAIRS,
    SKINS,
    draw_expression,
    draw_glasses,
    draw_head,
)
from probe_kit.suite.generators.drawing.palette import RGB, background_for
from probe_kit.suite.generators.generator import Concept, Generator

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
    """One emotion, 0 for none of it to 1 for all of it."""

    emotion: str = "neutral"
    strength: float = _STRONG


@dataclass(frozen=True)
class Face:
    """Everything the picture is drawn from; `ink` is the skin."""

    emotion: str
    strength: float
    ink: RGB
    hair: RGB
    long_hair: bool
    glasses: bool
    background: RGB
    placement: Placement

    def draw(self) -> Image.Image:
        """The tile, RGB."""
        canvas = Canvas(self.background)
        pen = canvas.pen(self.placement)
        draw_head(pen, self.ink, self.hair, self.long_hair)
        if self.glasses:
            draw_glasses(pen, self.ink)
        draw_expression(pen, EXPRESSIONS[self.emotion].at(self.strength), self.ink)
        return canvas.picture()


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


def _tiles(left: Feeling, right: Feeling, rng: np.random.Generator) -> tuple[Face, Face]:
    return _face(left, rng), _face(right, rng)


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
    tiles=_tiles,
)
