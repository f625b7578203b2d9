"""The training split's pictures, painted onto both tiles once and for all."""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pi0_tiny_training.painting import Brush
from probe_kit.suite.generators import GENERATORS
from probe_kit.suite.generators.couples import draw_couples
from probe_kit.suite.generators.generator import Tile
from probe_kit.suite.generators.outlines import OUTLINES
from probe_kit.suite.generators.palette import COLORS
from probe_kit.suite.generators.two_states import TWO_STATES
from probe_kit.suite.pictures import pixels_sha256
from probe_kit.suite.wording import instruction_for

CONCEPTS = {
    "color": tuple(COLORS),
    "outline": tuple(OUTLINES),
    "state": tuple(name for thing in TWO_STATES for name in (thing.first, thing.second)),
}
"""The axes along which the pictures of the training categories differ."""
EVALUATION_SEED, EVALUATION_COUPLES = 0, 75
"""The embedded suite has 150 items per category, two to a couple."""
NOTHING = -100
"""Where an axis does not apply; cross-entropy leaves this index out."""


@dataclass(frozen=True)
class PictureBank:
    """The tiles of one category's couples.

    painted: per side of the table, (N, 2, h, w, 3) uint8; the second axis is the couple's own left and right.
    texts: (N, 2), the instruction that asks for each tile.
    concepts: (N, 2, axes) int64, what each tile shows along each of `CONCEPTS`, or `NOTHING`.
    """

    category: str
    painted: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    texts: NDArray[np.str_]
    concepts: NDArray[np.int64]

    @classmethod
    def drawn(
        cls, category: str, seed: int, count: int, brushes: tuple[Brush, Brush], report: Callable[[str], None]
    ) -> Self:
        """The first `count` couples of the suite's generator at `seed`.

        Raises ValueError if a picture is one of the embedded suite's, on which the policy will be evaluated.
        """
        evaluation = _evaluation_pictures(category)
        couples = list(islice(draw_couples(GENERATORS[category], seed), count))
        painted: tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]] = ([], [])
        for number, couple in enumerate(couples):
            pictures = couple.left_tile.draw(), couple.right_tile.draw()
            if not evaluation.isdisjoint(map(pixels_sha256, pictures)):
                raise ValueError(f"couple {number} of {category} is in the evaluation split; change the seed")
            for side, brush in enumerate(brushes):
                values = np.stack([brush.paint(picture) for picture in pictures])
                painted[side].append(np.rint(values).astype(np.uint8))
            if number % 500 == 0:
                report(f"pictures of {category} {number}/{count}")
        texts = [[instruction_for(c.phrase, "the") for c in (couple.left, couple.right)] for couple in couples]
        concepts = [[_concepts(tile) for tile in (couple.left_tile, couple.right_tile)] for couple in couples]
        return cls(category, (np.stack(painted[0]), np.stack(painted[1])), np.array(texts), np.array(concepts))

    def save(self, path: Path) -> None:
        """Write to one .npz file."""
        left, right = self.painted
        np.savez(path, category=self.category, left=left, right=right, texts=self.texts, concepts=self.concepts)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read what `save` wrote."""
        with np.load(path) as arrays:
            painted = arrays["left"], arrays["right"]
            return cls(str(arrays["category"]), painted, arrays["texts"], arrays["concepts"])

    def by_pair(self) -> list[NDArray[np.int64]]:
        """Couples of the same two instructions, (n, 2) each: index, and 1 if the couple is the other way round."""
        pairs: dict[frozenset[str], list[tuple[int, int]]] = defaultdict(list)
        for index, (left, right) in enumerate(self.texts):
            pairs[frozenset((left, right))].append((index, int(left > right)))
        return [np.array(members) for _, members in sorted(pairs.items(), key=lambda entry: sorted(entry[0]))]


def _evaluation_pictures(category: str) -> set[str]:
    couples = islice(draw_couples(GENERATORS[category], EVALUATION_SEED), EVALUATION_COUPLES)
    return {pixels_sha256(tile.draw()) for couple in couples for tile in (couple.left_tile, couple.right_tile)}


def _concepts(tile: Tile) -> list[int]:
    """Index of what a tile shows, per axis."""
    return [
        names.index(getattr(tile, axis)) if hasattr(tile, axis) else NOTHING for axis, names in CONCEPTS.items()
    ]
