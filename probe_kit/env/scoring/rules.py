"""Outcome rules: when the cube counts as placed on a picture, judged from a stored trajectory.

A success rate is made of a policy *and* of a rule, and rules disagree on the same episodes by a factor of ten. So
a rule is a named object, every episode can be judged by all of them, and every printed rate comes with its rule's
name. All use the places of the tiles at the moment that is judged, which after a push is not where they began.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.env.scoring.outcome import REST_SPEED, Zone
from probe_kit.env.scoring.trajectory import Trajectory
from probe_kit.env.spec import SceneSpec
from probe_kit.errors import UsageError
from probe_kit.suite.items import Side, other_side

RELEASED_STEPS = 11
"""Control steps at the end that the released evaluation averages over."""

Flags = NDArray[np.bool_]


class OutcomeRule(ABC):
    """A rule that decides when the cube counts as put on a picture."""

    name: str

    @abstractmethod
    def inside(self, trajectory: Trajectory, side: Side) -> Flags:
        """(T + 1,) whether the cube counts as put on the picture on `side`, frame by frame. Not a number: no."""

    @property
    @abstractmethod
    def words(self) -> str:
        """The rule in a few words, with its numbers."""


@dataclass(frozen=True)
class Disc(OutcomeRule):
    """The middle of the cube, seen from above, is within `radius` metres of the middle of the picture."""

    radius: float
    name = "disc"

    def inside(self, trajectory: Trajectory, side: Side) -> Flags:
        """Height, grasp and motion do not count."""
        away = trajectory.cube[:, :2] - trajectory.tile(side)[:, :2]
        return np.asarray(np.hypot(*away.T) <= self.radius)

    @property
    def words(self) -> str:
        """The rule as captions print it."""
        return f"within {100 * self.radius:.1f} cm of the picture's middle, seen from above"


@dataclass(frozen=True)
class Box(OutcomeRule):
    """The middle of the cube is over a square of `half` metres to every side of the picture, `height` above it.

    The rule of the released evaluation. The square lies along x and y of the world, whatever way the tiles are
    turned, and `height` counts from the middle of the tile. The cube may be held, lie on the bare table or have
    been left where it started.
    """

    half: float
    height: float
    name = "box"

    def inside(self, trajectory: Trajectory, side: Side) -> Flags:
        """Held or lying, on the picture or beside it."""
        away = trajectory.cube[:, :3] - trajectory.tile(side)[:, :3]
        return np.asarray((np.abs(away[:, :2]) <= self.half).all(axis=1) & (away[:, 2] >= self.height))

    @property
    def words(self) -> str:
        """The rule as captions print it."""
        return f"over a square of {200 * self.half:.0f} cm around the picture, held or lying, on it or beside it"


@dataclass(frozen=True)
class ReleasedOnTile(OutcomeRule):
    """The cube was let go and lies still on the picture that can be seen: `half` metres to every side."""

    half: float
    name = "released-on-tile"

    def inside(self, trajectory: Trajectory, side: Side) -> Flags:
        """Demand the square of the tile as it lies, touch, open fingers, and rest."""
        tile, position = trajectory.tile(side), 0 if side == "left" else 1
        away = _turned_back(trajectory.cube[:, :2] - tile[:, :2], tile[:, 3:])
        over = (np.abs(away) <= self.half).all(axis=1)
        return np.asarray(
            over & trajectory.touches[:, position] & ~trajectory.held & (trajectory.cube_speed < REST_SPEED)
        )

    @property
    def words(self) -> str:
        """The rule as captions print it."""
        return f"let go and at rest on the picture, {200 * self.half:.1f} cm wide"


def _turned_back(away: NDArray[np.float32], quaternion: NDArray[np.float32]) -> NDArray[np.float32]:
    """(F, 2) offsets in the plane, seen from a tile that is turned about the vertical; quaternions x, y, z, w."""
    x, y, z, w = quaternion.T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    turned = np.stack([np.cos(yaw), np.sin(yaw), -np.sin(yaw), np.cos(yaw)], axis=1).reshape(-1, 2, 2)
    return np.asarray(np.einsum("fij,fj->fi", turned, away), np.float32)


@dataclass(frozen=True)
class Judgement:
    """The verdict of a rule on one episode.

    outcome: at its end. correct, wrong, oob: share of the judged steps, whole numbers where only the last one is
    judged. both: at its end the cube counts for both pictures, which is called correct. idle: the outcome if
    nothing had moved since before the first action.
    """

    outcome: Zone
    correct: float
    wrong: float
    oob: float
    both: bool
    idle: Zone


def judge(
    trajectory: Trajectory,
    rule: OutcomeRule,
    side_correct: Side,
    last_steps: int = 1,
    max_steps: int | None = None,
) -> Judgement:
    """Judge one episode by a rule.

    last_steps: how many control steps at the end count, each as much as the others. An episode that ended before
    `max_steps` is taken to have stayed as it was until then. Raises UsageError for fewer than one.
    """
    if last_steps < 1:
        raise UsageError(f"the last {last_steps} steps of an episode cannot be judged; expected at least 1")
    correct, wrong = rule.inside(trajectory, side_correct), rule.inside(trajectory, other_side(side_correct))
    end = max(trajectory.steps, max_steps or 0)
    judged = np.arange(max(1, end - last_steps + 1), end + 1).clip(max=trajectory.steps)
    right, other = correct[judged], wrong[judged] & ~correct[judged]
    return Judgement(
        outcome=_zone(bool(correct[-1]), bool(wrong[-1])),
        correct=float(right.mean()),
        wrong=float(other.mean()),
        oob=float((~right & ~other).mean()),
        both=bool(correct[-1] and wrong[-1]),
        idle=_zone(bool(correct[0]), bool(wrong[0])),
    )


def _zone(correct: bool, wrong: bool) -> Zone:
    return "correct" if correct else "wrong" if wrong else "oob"


# -- by name ---------------------------------------------------------------------------------------------

_DEFAULT = SceneSpec.__dataclass_fields__


def _disc(scene: Mapping[str, Any]) -> OutcomeRule:
    return Disc(scene["epsilon"])


def _box(scene: Mapping[str, Any]) -> OutcomeRule:
    """Scoring side and margins are newer than some scenes that are still read."""
    side, margin, height = (
        scene.get(name, _DEFAULT[name].default) for name in ("scoring_side", "box_margin", "box_height")
    )
    return Box(side / 2 + margin, height)


def _released(scene: Mapping[str, Any]) -> OutcomeRule:
    return ReleasedOnTile(scene["tile_side"] / 2)


_MAKERS: dict[str, Callable[[Mapping[str, Any]], OutcomeRule]] = {
    Disc.name: _disc,
    Box.name: _box,
    ReleasedOnTile.name: _released,
}
DEFAULT_RULE = Disc.name
RULES: Mapping[str, str] = MappingProxyType(
    {
        Disc.name: "the middle of the cube ends over a disc around the picture's middle (ours)",
        Box.name: "it ends over a wide square around the picture, held or lying (the released evaluation's)",
        ReleasedOnTile.name: "the cube was let go and lies still on the picture",
    }
)
"""Every rule by name, and what it asks for."""


def check_rule(name: str) -> str:
    """`name`, if there is such a rule. Raises UsageError, naming the nearest and all."""
    if name not in RULES:
        near = get_close_matches(name, RULES, n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise UsageError(f"there is no outcome rule {name!r}; {hint}rules: {', '.join(RULES)}")
    return name


def rule_of(name: str, scene: Mapping[str, Any]) -> OutcomeRule:
    """The rule of this name with the sizes of a scene, `SceneSpec.to_json()`. Raises UsageError."""
    return _MAKERS[check_rule(name)](scene)
