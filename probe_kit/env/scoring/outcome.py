"""Scoring of an episode by pure functions of numbers, so that re-scoring needs no simulator.

The rule of the paper uses the final position of the cube in the plane alone. Everything else in the record is
there for stricter variants and for telling a failed grasp from a wrong answer.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from probe_kit.env.spec import XY
from probe_kit.errors import SceneError
from probe_kit.suite.items import Layout, Side, other_side

Zone = Literal["correct", "wrong", "oob"]
Ending = Literal["max_steps", "cube_fell", "non_finite"]
SENSITIVITY_RADII = (0.055, 0.065, 0.081)
"""Half a tile side, the rule of VL-Think, half a diagonal plus 3 mm: metres, for the default tile."""


REST_SPEED = 0.002
"""Speed of the cube in m/s below which it lies still."""


def distance(a: XY, b: XY) -> float:
    """Distance in the plane, in the unit of the arguments."""
    return float(np.hypot(a[0] - b[0], a[1] - b[1]))


def zone(distance_correct: float, distance_wrong: float, radius: float) -> Zone:
    """Return the zone in which the cube ended, from its distances to both tile centres (all in one unit).

    A cube on the edge of a zone is inside. Out of bounds if it is in neither; if a distance is not a
    number, because the simulator broke, it is in neither. Raises SceneError if it would be in both.
    """
    on_correct, on_wrong = distance_correct <= radius, distance_wrong <= radius
    if on_correct and on_wrong:
        raise SceneError(
            f"zones of radius {radius} m overlap: the cube is {distance_correct:.3f} m from the correct and "
            f"{distance_wrong:.3f} m from the wrong tile. Use a smaller radius."
        )
    return "correct" if on_correct else "wrong" if on_wrong else "oob"


@dataclass(frozen=True)
class Outcome:
    """The stored result of one finished or running episode. Metres, in the world frame.

    zone: by the rule of the paper, with radius `epsilon`. cube_xy, cube_z: the middle of the cube.
    distance_correct, distance_wrong: in the plane, to the tile centres. cube_moved: it is further than
    `SceneSpec.moved` from where it started. on_tile: it touches a tile. is_grasped: both fingers touch it.
    clipped: how many actions the limits changed. truncation_reason: why the episode was cut, None if it is
    running or stopped early by itself.
    """

    zone: Zone
    layout: Layout
    side_correct: Side
    cube_xy: XY
    cube_z: float
    distance_correct: float
    distance_wrong: float
    epsilon: float
    cube_moved: bool
    on_tile: bool
    is_grasped: bool
    steps: int
    clipped: int
    truncation_reason: Ending | None

    @property
    def is_success(self) -> bool:
        """Whether the cube is in the correct zone."""
        return self.zone == "correct"

    @property
    def side_placed(self) -> Literal["left", "right", "none"]:
        """Side of the zone the cube is in."""
        if self.zone == "oob":
            return "none"
        return self.side_correct if self.is_success else other_side(self.side_correct)

    @property
    def never_moved(self) -> bool:
        """Out of bounds because the cube stayed where it was: a failed grasp rather than a wrong answer."""
        return self.zone == "oob" and not self.cube_moved

    def to_json(self) -> dict[str, Any]:
        """The record as plain JSON values; numbers that are not finite become None."""
        derived = {
            "is_success": self.is_success,
            "side_placed": self.side_placed,
            "never_moved": self.never_moved,
        }
        return {key: _plain(value) for key, value in (asdict(self) | derived).items()}


def success_by_radius(
    outcomes: Iterable[Outcome], radii: Sequence[float] = SENSITIVITY_RADII
) -> dict[float, float]:
    """Success rate for each zone radius in metres, from the stored distances: no episode runs again.

    Raises ValueError without outcomes, SceneError if a radius makes the zones overlap.
    """
    distances = [(o.distance_correct, o.distance_wrong) for o in outcomes]
    if not distances:
        raise ValueError("no outcomes to score; expected at least one.")
    return {radius: success_at(distances, radius) for radius in radii}


def success_at(distances: Iterable[tuple[float, float]], radius: float) -> float:
    """Success rate at a zone radius, metres, from distances to the correct and the wrong tile, metres.

    Raises SceneError if the radius makes the zones overlap.
    """
    return float(np.mean([zone(correct, wrong, radius) == "correct" for correct, wrong in distances]))


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
