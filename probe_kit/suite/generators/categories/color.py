"""Color: "red shape" against a shape of another basic colour, of the same outline in half of the pairs."""

from itertools import combinations

import numpy as np

from probe_kit.suite.generators.drawing.figure import Figure, colored_outline, random_figure
from probe_kit.suite.generators.drawing.outlines import OUTLINES
from probe_kit.suite.generators.drawing.palette import COLORS
from probe_kit.suite.generators.generator import Concept, Generator


def _tiles(left: Concept, right: Concept, rng: np.random.Generator) -> tuple[Figure, Figure]:
    one, other = rng.choice(list(OUTLINES), size=2, replace=False)
    if rng.integers(2):
        other = one
    return (
        random_figure(left.name, str(one), "edged", rng),
        random_figure(right.name, str(other), "edged", rng),
    )


COLOR = Generator(
    category="color",
    pairs=tuple(combinations([Concept(name, f"{name} shape") for name in COLORS], 2)),
    tiles=_tiles,
    named=colored_outline,
)
