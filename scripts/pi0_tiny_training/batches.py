"""Training batches: a demonstration's frame, two pictures on its tiles, and the instruction it then obeys."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pi0_tiny_training.demonstrations import Demonstrations
from pi0_tiny_training.painting import Brush
from pi0_tiny_training.pictures import CONCEPTS, PictureBank
from probe_kit.env.question import Question
from probe_kit.hooks.families.pi0.adapter import Pi0

UNUSED = "state"
"""The category whose answer is made readable but never acted on."""


@dataclass(frozen=True)
class Batch:
    """One batch; the first axis of everything is B.

    pictures: (B, 3, 96, 96) float32 in [0, 1]. texts: B instructions. states: (B, 8), chunks: (B, chunk, 7),
    both normalised. side: (B,) int64, 0 if the asked tile lies left. used: (B,) bool, whether the actions go
    there; those of the unused category do so by chance only. concepts: (B, 2, axes) int64, for the left and
    the right tile along `CONCEPTS`.
    """

    pictures: Tensor
    texts: list[str]
    states: Tensor
    chunks: Tensor
    side: Tensor
    used: Tensor
    concepts: Tensor


class Sampler:
    """Draws batches; the same seed and number give the same batch."""

    def __init__(
        self,
        demonstrations: Demonstrations,
        banks: Sequence[PictureBank],
        shares: Sequence[float],
        brushes: tuple[Brush, Brush],
        policy: Pi0,
    ) -> None:
        self._demonstrations = demonstrations
        self._banks, self._shares = list(banks), np.array(shares) / np.sum(shares)
        self._pairs = [bank.by_pair() for bank in banks]
        self._brushes = brushes
        self._policy = policy
        self._deciding = np.flatnonzero(demonstrations.deciding)
        self._visible = [_visible(demonstrations, brush, place) for place, brush in enumerate(brushes)]

    def batch(self, rng: np.random.Generator, size: int, deciding_share: float, by_lot: bool) -> Batch:
        """`size` samples, of which `deciding_share` are frames that need the instruction to be understood.

        by_lot: draw the asked side of the unused category, whatever the demonstration does; otherwise its
        demonstrations are right, and must not be trained on.
        """
        frames = np.where(
            rng.random(size) < deciding_share,
            rng.choice(self._deciding, size),
            rng.integers(len(self._demonstrations.side), size=size),
        )
        kinds = rng.choice(len(self._banks), size=size, p=self._shares)
        pictures = self._demonstrations.pictures[frames].astype(np.float32)
        concepts = np.zeros((size, 2, len(CONCEPTS)), np.int64)
        sides = self._demonstrations.side[frames].astype(np.int64)
        texts = []
        for row, (frame, kind) in enumerate(zip(frames, kinds, strict=True)):
            bank, pair = self._banks[kind], self._pairs[kind][rng.integers(len(self._pairs[kind]))]
            if by_lot and bank.category == UNUSED:
                sides[row] = rng.integers(2)
            side = int(sides[row])
            asked = int(rng.integers(2))
            for place, wanted in ((side, asked), (1 - side, 1 - asked)):
                couple, turned = pair[rng.integers(len(pair))]
                member = wanted ^ turned
                brush = self._brushes[place]
                layer = bank.painted[place][couple, member] * self._visible[place][frame]
                pictures[row, brush.rows, brush.columns] += layer
                concepts[row, place] = bank.concepts[couple, member]
                if wanted == asked:
                    texts.append(str(bank.texts[couple, member]))
        used = np.array([self._banks[kind].category != UNUSED for kind in kinds])
        return self._as_tensors(frames, pictures, texts, sides, used, concepts)

    def _as_tensors(
        self, frames: NDArray[np.int64], pictures: NDArray[np.float32], texts: list[str], sides: NDArray[np.int64],
        used: NDArray[np.bool_], concepts: NDArray[np.int64],
    ) -> Batch:  # fmt: skip
        rows = self._demonstrations
        return Batch(
            torch.from_numpy((pictures.clip(0, 255) / 255).transpose(0, 3, 1, 2).copy()),
            texts,
            torch.from_numpy(self._policy.state_units.normalise(rows.states[frames])),
            torch.from_numpy(self._policy.action_units.normalise(rows.chunks[frames])),
            torch.from_numpy(sides),
            torch.from_numpy(used),
            torch.from_numpy(concepts),
        )


def without_pictures(demonstrations: Demonstrations, brushes: tuple[Brush, Brush]) -> Demonstrations:
    """The demonstrations with black tiles: what the plain pictures they were recorded with added is taken off."""
    pictures = demonstrations.pictures.astype(np.float32)
    plain = [Question.built_in(layout).pictures for layout in ("original", "swapped")]
    for place, (name, brush) in enumerate(zip(("left", "right"), brushes, strict=True)):
        paint = np.stack([brush.paint(question[name]) for question in plain])[demonstrations.side]
        pictures[:, brush.rows, brush.columns] -= paint * _visible(demonstrations, brush, place)
    return replace(demonstrations, pictures=pictures.clip(0, 255).round().astype(np.uint8))


def _visible(demonstrations: Demonstrations, brush: Brush, place: int) -> NDArray[np.float64]:
    """(F, h, w, 1), how much of the tile's own share of each pixel the frame shows."""
    share = demonstrations.tiles[:, place, brush.rows, brush.columns] / 255
    shown = (share / np.maximum(brush.cover, 1e-3)).clip(0, 1) * (brush.cover > 1e-3)
    return np.asarray(shown[..., None])
