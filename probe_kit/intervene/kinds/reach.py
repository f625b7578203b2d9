"""A policy's reach: the unit of displacements. Reads stored outcomes; needs no model."""

from dataclasses import dataclass
from math import hypot
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.train.data.run_reader import RunReader

FEWEST_TO_EITHER_SIDE = 8
"""Clean inferences that must go to either side before a reach is taken from them."""
SMALLEST_REACH = 0.02
"""Metres. Two sides that are nearer to each other are no choice between tiles."""
REACHED = 0.25
"""Share of the reach from which a side counts as reached."""
TILES_APART = 0.31
"""Metres between the tiles of the default scene; taken for a run that stores no scene."""


@dataclass(frozen=True)
class Reach:
    """The lateral distance between a policy's own two choices.

    metres: more than zero. source: `actions`, the clean inferences of all categories, or `tiles`, the distance
    between the tiles, where too few inferences go to one of the sides.
    """

    metres: float
    source: Literal["actions", "tiles"]

    @classmethod
    def of(cls, clean: NDArray[np.float64], tiles_apart: float = TILES_APART) -> "Reach":
        """From (E,) clean lateral displacements, metres, left positive, over all categories of one intervention.

        Medians: a few categories in which the policy moves weakly do not shorten it.
        """
        left, right = clean[clean > 0], clean[clean < 0]
        if min(left.size, right.size) >= FEWEST_TO_EITHER_SIDE:
            metres = float(np.median(left) - np.median(right))
            if metres >= SMALLEST_REACH:
                return cls(metres, "actions")
        return cls(tiles_apart, "tiles")


def tiles_apart(run: RunReader) -> float:
    """Metres between the middles of the two tiles of a run's scene; of the default scene if it stores none."""
    scene: Any = getattr(run, "settings", {}).get("scene", {})
    if "tile_left" not in scene or "tile_right" not in scene:
        return TILES_APART
    (left_x, left_y), (right_x, right_y) = scene["tile_left"], scene["tile_right"]
    return hypot(left_x - right_x, left_y - right_y)
