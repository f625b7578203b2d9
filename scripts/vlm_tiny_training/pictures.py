"""The training split's pictures, painted onto every surface once and for all."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.suite.generators import GENERATORS
from probe_kit.suite.generators.generator import draw_couples
from probe_kit.suite.pictures import pixels_sha256
from vlm_tiny_training.painting import Surface

EVALUATION_SEEDS = (0, 1, 2, 11, 12)
"""Suites are drawn from seed 0 by default; verdicts are tested on the next two too, and rates on the last."""
EVALUATION_COUPLES = 75
"""The embedded suite has 150 items per category, two to a couple."""
Painted = Mapping[str, tuple[NDArray[np.uint8], NDArray[np.uint8]]]


@dataclass(frozen=True)
class PictureBank:
    """The tiles of one category's couples.

    Attributes:
        painted: Per surface and side, (N, 2, h, w, 3) uint8; the second axis is the couple's own left and right.
        phrases: (N, 2), what each tile is called.
    """

    category: str
    painted: Painted
    phrases: NDArray[np.str_]

    @classmethod
    def drawn(
        cls,
        category: str,
        seed: int,
        count: int,
        surfaces: Mapping[str, Surface],
        report: Callable[[str], None],
    ) -> Self:
        """The first `count` couples of the suite's generators at `seed`.

        Raises:
            ValueError: If a picture is one of an embedded suite's, on which the models will be evaluated.
        """
        painted: dict[str, tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]]]
        painted = {name: ([], []) for name in surfaces}
        phrases: list[list[str]] = []
        evaluation = _evaluation_pictures(category)
        for number, couple in enumerate(islice(draw_couples(GENERATORS[category], seed), count)):
            pictures = couple.left_tile.draw(), couple.right_tile.draw()
            if not evaluation.isdisjoint(map(pixels_sha256, pictures)):
                raise ValueError(f"couple {number} of {category} is in the evaluation split; change the seed")
            for name, surface in surfaces.items():
                for side, area in enumerate(surface.places):
                    values = np.stack([area.paint(picture) for picture in pictures])
                    painted[name][side].append(np.rint(values).clip(0, 255).astype(np.uint8))
            phrases.append([couple.left.phrase, couple.right.phrase])
            if number % 500 == 0:
                report(f"pictures of {category}: {number}/{count}")
        arrays = {name: (np.stack(left), np.stack(right)) for name, (left, right) in painted.items()}
        return cls(category, arrays, np.array(phrases))

    def save(self, path: Path) -> None:
        """Write to one .npz file."""
        sides = {f"{name}.{side}": pair[side] for name, pair in self.painted.items() for side in (0, 1)}
        np.savez(path, category=self.category, phrases=self.phrases, **sides)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read what `save` wrote."""
        with np.load(path) as arrays:
            names = [name.removesuffix(".0") for name in arrays if name.endswith(".0")]
            painted = {name: (arrays[f"{name}.0"], arrays[f"{name}.1"]) for name in names}
            return cls(str(arrays["category"]), painted, arrays["phrases"])

    def by_pair(self) -> list[NDArray[np.int64]]:
        """Couples of the same two phrases, (n, 2) each: index, and 1 if the couple is the other way round."""
        pairs: dict[frozenset[str], list[tuple[int, int]]] = defaultdict(list)
        for index, (left, right) in enumerate(self.phrases):
            pairs[frozenset((left, right))].append((index, int(left > right)))
        return [np.array(members) for _, members in sorted(pairs.items(), key=lambda entry: sorted(entry[0]))]


def _evaluation_pictures(category: str) -> set[str]:
    return {
        pixels_sha256(tile.draw())
        for seed in EVALUATION_SEEDS
        for couple in islice(draw_couples(GENERATORS[category], seed), EVALUATION_COUPLES)
        for tile in (couple.left_tile, couple.right_tile)
    }


def read_banks(
    folder: Path,
    categories: Sequence[str],
    seed: int,
    count: int,
    surfaces: Mapping[str, Surface],
    processes: int,
    report: Callable[[str], None],
) -> list[PictureBank]:
    """The pictures of every category, kept in `folder`; drawn by several processes at once."""
    paths = {category: folder / f"pictures-{category}.npz" for category in categories}
    missing = [category for category, path in paths.items() if not path.is_file()]
    if missing:
        with get_context("fork").Pool(min(processes, len(missing))) as pool:
            jobs = [(category, seed, count, surfaces, report) for category in missing]
            for category, bank in zip(missing, pool.starmap(PictureBank.drawn, jobs, 1), strict=True):
                bank.save(paths[category])
    return [PictureBank.read(path) for path in paths.values()]
