"""Frames of demonstrations, onto whose tiles pictures are painted."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from vlm_tiny_training.batches import Pair, Pixels
from vlm_tiny_training.painting import Place, Surface

from acting_training.demonstrations import Demonstrations
from probe_kit.env.act2answer import Question


class Frames:
    """All frames of some demonstrations, with black tiles."""

    def __init__(self, name: str, surface: Surface, demonstrations: Demonstrations) -> None:
        self.name = name
        self._places = surface.places
        self._visible = [_visible(demonstrations, area, side) for side, area in enumerate(surface.places)]
        self.rows = _without_pictures(demonstrations, surface, self._visible)
        self._first = np.flatnonzero(self.rows.first)

    def draw(self, rng: np.random.Generator, first: float, size: int) -> NDArray[np.int64]:
        """(size,) numbers of frames, a share of which is where an episode begins."""
        return np.where(
            rng.random(size) < first,
            rng.choice(self._first, size),
            rng.integers(len(self.rows.side), size=size),
        )

    def painted(self, frame: int, pair: Pair, side: int) -> Pixels:
        """(96, 96, 3) float32 in [0, 255]: the asked picture on `side` (0 left), the other one opposite."""
        picture = self.rows.pictures[frame].astype(np.float32)
        for where, (couple, member) in zip((side, 1 - side), pair.pictures, strict=True):
            area = self._places[where]
            layer = pair.bank.painted[self.name][where][couple, member] * self._visible[where][frame]
            picture[area.rows, area.columns] += layer
        return picture.clip(0, 255)


def _without_pictures(
    demonstrations: Demonstrations, surface: Surface, visible: list[NDArray[np.float32]]
) -> Demonstrations:
    """What the plain pictures they were recorded with added is taken off."""
    pictures = demonstrations.pictures.astype(np.float32)
    plain = [Question.built_in(layout).pictures for layout in ("original", "swapped")]
    for side, (name, area) in enumerate(zip(("left", "right"), surface.places, strict=True)):
        paint = np.stack([area.paint(question[name]) for question in plain])[demonstrations.side]
        pictures[:, area.rows, area.columns] -= paint * visible[side]
    return replace(demonstrations, pictures=pictures.clip(0, 255).round().astype(np.uint8))


def _visible(demonstrations: Demonstrations, area: Place, side: int) -> NDArray[np.float32]:
    """(F, h, w, 1), how much of the tile's own share of each pixel the frame shows."""
    share = demonstrations.tiles[:, side, area.rows, area.columns] / np.float32(255)
    visible = (share / np.maximum(area.cover, 1e-3)).clip(0, 1) * (area.cover > 1e-3)
    return np.asarray(visible[..., None], np.float32)
