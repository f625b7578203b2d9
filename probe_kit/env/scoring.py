"""Scoring of an episode by pure functions of its trajectory: outcome, events, outcome rules, behaviour.

A frame is the state before the first action or after one; frame t follows action t. All statements about an
episode are computed from its frames, so that re-scoring needs no simulator.

The rule of the paper uses the final position of the cube in the plane alone. A success rate depends on a policy
*and* on a rule, and rules disagree on the same episodes by a factor of ten. So a rule is a named object, every
episode can be judged by all of them, and every printed rate comes with its rule's name. All use the places of the
tiles at the moment that is judged, which after a push is not where they began.

The start biases some of the behaviour. In the released scene the hand starts over the right picture's box. So
every answer to the right is also the "first choice", and the hand is nearer to the right picture before it has
moved. The part that the start contributes is therefore left out (first choice, dwell, closer to, release) or named
separately (side of the start).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.env.spec import XY, SceneSpec
from probe_kit.errors import SceneError, UsageError
from probe_kit.suite.items import Layout, Side, other_side

if TYPE_CHECKING:
    import xarray as xr


Values = NDArray[np.float32]

POSE: tuple[str, ...] = ("x", "y", "z", "qx", "qy", "qz", "qw")
STATE: dict[str, tuple[str, ...]] = {
    "tool": ("x", "y", "z", "roll", "pitch", "yaw"),
    "opening": ("share",),
    "cube": POSE,
    "cube_speed": ("m/s",),
    "tile_left": POSE,
    "tile_right": POSE,
    "finger_force": ("one", "other"),
    "held": ("bool",),
    "touches": ("left", "right"),
}
"""Names of a frame's parts, and of the components of each."""
MOTION: tuple[str, ...] = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
ACTIONS: dict[str, tuple[str, ...]] = {"commanded": MOTION, "executed": MOTION, "ik_error": ("m",)}
"""Parts that describe the action before a frame; not a number in the first frame."""
CHANNELS: tuple[str, ...] = tuple(f"{name}.{part}" for name, parts in (STATE | ACTIONS).items() for part in parts)
"""Columns of a stored frame, in order."""
_AXES = {MOTION: "motion", POSE: "pose"}
LED_TO = sum(len(parts) for parts in ACTIONS.values())
"""Number of columns that describe the action."""


@dataclass(frozen=True)
class Trajectory:
    """One episode of T actions in T + 1 frames; float32, metres, radians, seconds, newtons, in the world frame.

    Attributes:
        tool: (T + 1, 6) measured x, y, z, roll, pitch, yaw, the angles relative to pointing down.
        opening: (T + 1,) opening of the gripper, 1 open.
        cube: (T + 1, 7) middle of the body x, y, z and its quaternion x, y, z, w.
        cube_speed: (T + 1,) speed of the cube in m/s.
        tile_left: (T + 1, 7) pose of the tile that started left, in the form of `cube`.
        tile_right: (T + 1, 7) pose of the tile that started right, in the form of `cube`.
        finger_force: (T + 1, 2) force with which each finger presses on the cube.
        held: (T + 1,) bool, whether both fingers touch the cube.
        touches: (T + 1, 2) bool, whether the cube touches the left or right tile.
        commanded: (T, 7) actions as they came.
        executed: (T, 7) real advance of the commanded pose, after limits, a gripper that is kept shut, and poses
            out of reach (zero then).
        ik_error: (T,) metres that remained to the requested position.
    """

    tool: Values
    opening: Values
    cube: Values
    cube_speed: Values
    tile_left: Values
    tile_right: Values
    finger_force: Values
    held: NDArray[np.bool_]
    touches: NDArray[np.bool_]
    commanded: Values
    executed: Values
    ik_error: Values

    @classmethod
    def of_frames(cls, frames: Values) -> Self:
        """Return the trajectory of stored frames (T + 1, len(CHANNELS)); see `frames`."""
        parts: dict[str, NDArray[Any]] = {}
        start = 0
        for name, of_name in (STATE | ACTIONS).items():
            columns = frames[:, start : start + len(of_name)]
            start += len(of_name)
            columns = columns[1:] if name in ACTIONS else columns
            columns = columns[:, 0] if len(of_name) == 1 else columns
            parts[name] = columns > 0 if name in ("held", "touches") else columns
        return cls(**parts)

    @property
    def frames(self) -> Values:
        """The frames (T + 1, len(CHANNELS)) float32 as stored: state, then the action before, NaN in the first."""
        frames = np.full((len(self), len(CHANNELS)), np.nan, np.float32)
        start = 0
        for name, of_name in (STATE | ACTIONS).items():
            first = 1 if name in ACTIONS else 0
            values = getattr(self, name)
            frames[first:, start : start + len(of_name)] = values.reshape(len(values), len(of_name))
            start += len(of_name)
        return frames

    def __len__(self) -> int:
        """Return the number of frames, T + 1."""
        return len(self.tool)

    @property
    def steps(self) -> int:
        """The number of actions, T."""
        return len(self.commanded)

    def tile(self, side: Side) -> Values:
        """Return the pose (T + 1, 7) of the tile on `side`."""
        return self.tile_left if side == "left" else self.tile_right

    def to_xarray(self) -> "xr.Dataset":
        """Return the trajectory with labelled axes: `frame` from 0, `step` from 1, and the parts by name."""
        import xarray as xr

        arrays: dict[str, xr.DataArray] = {}
        for name, parts in (STATE | ACTIONS).items():
            time = "step" if name in ACTIONS else "frame"
            if len(parts) == 1:
                arrays[name] = xr.DataArray(getattr(self, name), dims=(time,))
            else:
                axis = _AXES.get(parts, f"{name}_part")
                arrays[name] = xr.DataArray(getattr(self, name), dims=(time, axis), coords={axis: list(parts)})
        times = {"frame": np.arange(len(self)), "step": np.arange(1, len(self))}
        return xr.Dataset(arrays, coords=times)


# -- outcome --------------------------------------------------------------------------------------------------

Zone = Literal["correct", "wrong", "oob"]
Ending = Literal["max_steps", "cube_fell", "non_finite"]
SENSITIVITY_RADII = (0.055, 0.065, 0.081)
"""Half a tile side, the rule of VL-Think, half a diagonal plus 3 mm: in metres, for the default tile."""


REST_SPEED = 0.002
"""Speed of the cube, in m/s, below which it lies still."""


def distance(a: XY, b: XY) -> float:
    """Return the distance in the plane, in the unit of the arguments."""
    return float(np.hypot(a[0] - b[0], a[1] - b[1]))


def zone(distance_correct: float, distance_wrong: float, radius: float) -> Zone:
    """Return the zone in which the cube ended, from its distances to both tile centres (all in one unit).

    A cube on the edge of a zone is inside. It is out of bounds if it is in neither zone. If a distance is not a
    number, because the simulator broke, it is in neither.

    Raises:
        SceneError: If it would be in both.
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
    """The stored result of one finished or running episode, in metres, in the world frame.

    Attributes:
        zone: Zone of the cube by the rule of the paper, with radius `epsilon`.
        cube_xy: Middle of the cube in the plane.
        cube_z: Height of the cube's middle.
        distance_correct: Distance of the cube to the correct tile's centre, in the plane.
        distance_wrong: Distance of the cube to the wrong tile's centre, in the plane.
        epsilon: Radius of the zones.
        cube_moved: Whether the cube is further than `SceneSpec.moved` from its start.
        on_tile: Whether the cube touches a tile at the end; `Run.behaviour` says whether it ever did.
        is_grasped: Whether both fingers touch the cube at the end; `Run.behaviour` says whether they ever did.
        steps: Number of executed actions.
        clipped: Number of actions that the limits changed.
        truncation_reason: Reason why the episode was cut; None if it is running or stopped early by itself.
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
        """The side of the zone that the cube is in; "none" if it is out of bounds."""
        if self.zone == "oob":
            return "none"
        return self.side_correct if self.is_success else other_side(self.side_correct)

    @property
    def never_moved(self) -> bool:
        """Whether the cube is out of bounds because it stayed at its start.

        That is a failed grasp rather than a wrong answer.
        """
        return self.zone == "oob" and not self.cube_moved

    def to_json(self) -> dict[str, Any]:
        """Return the record as plain JSON values; numbers that are not finite become None."""
        derived = {
            "is_success": self.is_success,
            "side_placed": self.side_placed,
            "never_moved": self.never_moved,
        }
        return {key: _plain(value) for key, value in (asdict(self) | derived).items()}


def success_by_radius(
    outcomes: Iterable[Outcome], radii: Sequence[float] = SENSITIVITY_RADII
) -> dict[float, float]:
    """Return the success rate for each zone radius in metres, from the stored distances: no episode runs again.

    Raises:
        ValueError: Without outcomes.
        SceneError: If a radius makes the zones overlap.
    """
    distances = [(o.distance_correct, o.distance_wrong) for o in outcomes]
    if not distances:
        raise ValueError("no outcomes to score; expected at least one.")
    return {radius: success_at(distances, radius) for radius in radii}


def success_at(distances: Iterable[tuple[float, float]], radius: float) -> float:
    """Return the success rate at a zone radius from distances to the correct and the wrong tile, all in metres.

    Raises:
        SceneError: If the radius makes the zones overlap.
    """
    return float(np.mean([zone(correct, wrong, radius) == "correct" for correct, wrong in distances]))


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


# -- events ---------------------------------------------------------------------------------------------------

MOVED = 0.005
"""Metres from its first place by which the tool has set off; less is the arm settling."""
LATERAL = 0.02
"""Metres towards either tile, of some 0.31 between them, by which the tool has committed to a side."""

EVENTS = ("first motion", "grasp", "first lateral move", "release")


@dataclass(frozen=True)
class Events:
    """Frames of one episode at which something was first the case; None for what never happened.

    Attributes:
        first_motion: The tool has left its place.
        grasp: The cube is held.
        first_lateral_move: After the grasp, the tool has moved `LATERAL` along the line between the tiles from the
            place of the grasp. Before the grasp it goes to the cube, whatever the question.
        release: The cube is not held any more, and not again. Frame t follows action t, so that the action with
            that number caused it.
    """

    first_motion: int | None
    grasp: int | None
    first_lateral_move: int | None
    release: int | None

    @classmethod
    def of(cls, trajectory: Trajectory) -> "Events":
        """Return the events of a trajectory, from the positions frame by frame."""
        tool = trajectory.tool[:, :3].astype(np.float64)
        grasp = _first(trajectory.held)
        frames = np.flatnonzero(trajectory.held)
        release = None if frames.size == 0 or frames[-1] + 1 == len(trajectory) else int(frames[-1]) + 1
        return cls(
            first_motion=_first(np.linalg.norm(tool - tool[0], axis=1) > MOVED),
            grasp=grasp,
            first_lateral_move=None if grasp is None else _lateral(trajectory, tool, grasp),
            release=release,
        )

    def frame(self, event: str) -> int | None:
        """Return the frame of an event by its name in `EVENTS`."""
        frame: int | None = getattr(self, event.replace(" ", "_"))
        return frame


def _lateral(trajectory: Trajectory, tool: NDArray[np.float64], grasp: int) -> int | None:
    across = (trajectory.tile_left[0, :2] - trajectory.tile_right[0, :2]).astype(np.float64)
    length = float(np.linalg.norm(across))
    if length == 0:
        return None
    moved = np.abs((tool[:, :2] - tool[grasp, :2]) @ (across / length))
    moved[: grasp + 1] = 0
    return _first(moved > LATERAL)


def _first(happened: NDArray[np.bool_]) -> int | None:
    frames = np.flatnonzero(happened)
    return int(frames[0]) if frames.size else None


# -- outcome rules --------------------------------------------------------------------------------------------

RELEASED_STEPS = 11
"""Control steps at the end over which the released evaluation averages."""

Flags = NDArray[np.bool_]


class OutcomeRule(ABC):
    """A rule that decides when the cube counts as put on a picture."""

    name: str

    @abstractmethod
    def inside(self, trajectory: Trajectory, side: Side) -> Flags:
        """Return (T + 1,) whether the cube counts as put on the picture on `side`, frame by frame.

        A position that is not a number does not count.
        """

    @property
    @abstractmethod
    def words(self) -> str:
        """The rule in a few words, with its numbers."""


@dataclass(frozen=True)
class Disc(OutcomeRule):
    """A rule: the middle of the cube, seen from above, is within `radius` metres of the picture's middle."""

    radius: float
    name = "disc"

    def inside(self, trajectory: Trajectory, side: Side) -> Flags:
        """Return (T + 1,) whether the cube is within the disc; height, grasp and motion do not count."""
        away = trajectory.cube[:, :2] - trajectory.tile(side)[:, :2]
        return np.asarray(np.hypot(*away.T) <= self.radius)

    @property
    def words(self) -> str:
        """The rule as captions print it."""
        return f"within {100 * self.radius:.1f} cm of the picture's middle, seen from above"


@dataclass(frozen=True)
class Box(OutcomeRule):
    """A rule: the middle of the cube is over a square around the picture, and high enough.

    It is the rule of the released evaluation. The square lies along x and y of the world, whatever way the tiles
    are turned. The cube may be held, lie on the bare table or have been left at its start.

    Attributes:
        half: Metres from the middle of the picture to each side of the square.
        height: Metres from the middle of the tile up to the least height of the cube's middle.
    """

    half: float
    height: float
    name = "box"

    def inside(self, trajectory: Trajectory, side: Side) -> Flags:
        """Return (T + 1,) whether the cube is over the square, held or lying, on the picture or next to it."""
        away = trajectory.cube[:, :3] - trajectory.tile(side)[:, :3]
        return np.asarray((np.abs(away[:, :2]) <= self.half).all(axis=1) & (away[:, 2] >= self.height))

    @property
    def words(self) -> str:
        """The rule as captions print it."""
        return f"over a square of {200 * self.half:.0f} cm around the picture, held or lying, on it or beside it"


@dataclass(frozen=True)
class ReleasedOnTile(OutcomeRule):
    """A rule: the cube was released and lies still on the visible picture, `half` metres to every side."""

    half: float
    name = "released-on-tile"

    def inside(self, trajectory: Trajectory, side: Side) -> Flags:
        """Return (T + 1,) whether the cube is on the tile as it lies, touches it, is released, and rests."""
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
    """Return offsets (F, 2) in the plane as seen from a tile that is turned about the vertical.

    The tile's quaternions (F, 4) are x, y, z, w.
    """
    x, y, z, w = quaternion.T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    turned = np.stack([np.cos(yaw), np.sin(yaw), -np.sin(yaw), np.cos(yaw)], axis=1).reshape(-1, 2, 2)
    return np.asarray(np.einsum("fij,fj->fi", turned, away), np.float32)


@dataclass(frozen=True)
class Judgement:
    """The verdict of a rule on one episode.

    Attributes:
        outcome: Zone at the end of the episode.
        correct: Share of the judged steps in the correct zone; 0 or 1 where only the last step is judged.
        wrong: Share of the judged steps in the wrong zone alone.
        oob: Share of the judged steps in neither.
        both: Whether the cube counts for both pictures at the end, which is called correct.
        idle: Outcome if nothing had moved since before the first action.
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

    An episode that ended before `max_steps` is taken to have stayed as it was until then.

    Args:
        trajectory: Trajectory of the episode.
        rule: Rule that decides when the cube counts as put on a picture.
        side_correct: Side of the correct picture in the episode's layout.
        last_steps: Number of control steps at the end that count, each as much as the others.
        max_steps: Actions of a full episode; None to judge the episode's own last steps.

    Raises:
        UsageError: For less than one step.
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


DEFAULT_RULE = Disc.name
RULES: Mapping[str, str] = MappingProxyType(
    {
        Disc.name: "the middle of the cube ends over a disc around the picture's middle (ours)",
        Box.name: "it ends over a wide square around the picture, held or lying (the released evaluation's)",
        ReleasedOnTile.name: "the cube was let go and lies still on the picture",
    }
)
"""Every rule by name, with its condition in words."""


def check_rule(name: str) -> str:
    """Return `name`, if there is such a rule.

    Raises:
        UsageError: For another name; the message has the nearest rule and all of them.
    """
    if name not in RULES:
        near = get_close_matches(name, RULES, n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise UsageError(f"there is no outcome rule {name!r}; {hint}rules: {', '.join(RULES)}")
    return name


def rule_of(name: str, scene: Mapping[str, Any]) -> OutcomeRule:
    """Return the rule of this name with the sizes of a scene, `SceneSpec.to_json()`.

    Raises:
        UsageError: For an unknown name.
    """
    return _MAKERS[check_rule(name)](scene)


def _box(scene: Mapping[str, Any]) -> OutcomeRule:
    # Scoring side and margins are newer than some scenes that are still read.
    side, margin, height = (
        scene.get(field, _DEFAULT[field].default) for field in ("scoring_side", "box_margin", "box_height")
    )
    return Box(side / 2 + margin, height)


_MAKERS: dict[str, Callable[[Mapping[str, Any]], OutcomeRule]] = {
    Disc.name: lambda scene: Disc(scene["epsilon"]),
    Box.name: _box,
    ReleasedOnTile.name: lambda scene: ReleasedOnTile(scene["tile_side"] / 2),
}


# -- behaviour ------------------------------------------------------------------------------------------------

Choice = Literal["correct", "wrong", "none"]

HAND_ABOVE = 0.02
"""Metres above the middle of a tile from which on the tool counts as over it (the released evaluation's)."""


TIE = 1e-3
"""Metres by which a gain has to be the larger one."""


@dataclass(frozen=True)
class Behaviour:
    """The behaviour in one episode; metres, shares from 0 to 1, control steps, or None where it is not defined.

    Attributes:
        grasped: Whether both fingers ever touched the cube.
        released: Whether the hand released the cube after a grasp.
        released_at: Frame of the first release; None without one.
        moved: Whether the cube was ever further than `SceneSpec.moved` from its start, seen from above.
        furthest: Largest distance of the cube from its start.
        hand_starts_over: Picture that the hand is over before the first action.
        hand_starts_nearer: Picture that the hand is nearer to before the first action.
        first_choice: Picture whose box the hand was brought into first. The box in which it began counts from when
            the hand is nearer to that picture by more than `SceneSpec.moved`. It also counts if the hand was away
            and came back.
        dwell_correct: Steps over the correct picture's box, counted likewise.
        dwell_wrong: Steps over the wrong picture's box, counted likewise.
        dwell_start: Steps over a box that are left out of the other two counts.
        min_distance_correct: Least distance of the hand to the correct picture, seen from above, over the whole
            episode.
        min_distance_wrong: Least distance of the hand to the wrong picture, seen from above, over the whole
            episode.
        closer_to: Picture to which the hand came closer than it was at the start, by the larger gain.
        release_near: Picture whose box the hand was over at the first release, counted likewise; None if it
            released nothing.
        correct_side_share: Share of steps with the hand on the correct side of the line between the pictures.
        start_side_correct: Whether the hand began on that side.
    """

    grasped: bool
    released: bool
    released_at: int | None
    moved: bool
    furthest: float
    hand_starts_over: Choice
    hand_starts_nearer: Choice
    first_choice: Choice
    dwell_correct: int
    dwell_wrong: int
    dwell_start: int
    min_distance_correct: float
    min_distance_wrong: float
    closer_to: Choice
    release_near: Choice | None
    correct_side_share: float
    start_side_correct: bool


def behaviour_of(trajectory: Trajectory, side_correct: Side, box_half: float, moved: float) -> Behaviour:
    """Describe the behaviour in one episode.

    Args:
        trajectory: Trajectory of the episode.
        side_correct: Side of the correct picture in the episode's layout.
        box_half: Half the side of the box of the rule `box`, in metres, see `SceneSpec.box_half`.
        moved: Distance in metres from which on the cube or hand counts as moved, see `SceneSpec.moved`.
    """
    sides: tuple[Side, Side] = (side_correct, other_side(side_correct))
    over = [_over(trajectory, side, box_half) for side in sides]
    distances = [np.hypot(*(trajectory.tool[:, :2] - trajectory.tile(side)[:, :2]).T) for side in sides]
    correct, wrong = (
        over_picture & ~_left_where_it_began(over_picture, away, moved)
        for over_picture, away in zip(over, distances, strict=True)
    )
    # The smallest that is a number: the simulator may break in mid-episode, not before.
    start, least = [float(away[0]) for away in distances], [float(np.nanmin(away)) for away in distances]
    gains = [first - nearest for first, nearest in zip(start, least, strict=True)]
    furthest = float(np.nanmax(np.hypot(*(trajectory.cube[:, :2] - trajectory.cube[0, :2]).T)))
    last_held, entered = _first(trajectory.held[:-1] & ~trajectory.held[1:]), _first(correct | wrong)
    released_at = None if last_held is None else last_held + 1
    towards_correct = _offset_to_correct_side(trajectory, side_correct)

    def at(frame: int) -> Choice:
        return _choice(bool(correct[frame]), bool(wrong[frame]))

    return Behaviour(
        grasped=bool(trajectory.held.any()),
        released=released_at is not None,
        released_at=released_at,
        moved=furthest > moved,
        furthest=furthest,
        hand_starts_over=_choice(bool(over[0][0]), bool(over[1][0])),
        hand_starts_nearer=_choice(start[0] < start[1], start[1] < start[0]),
        first_choice="none" if entered is None else at(entered),
        dwell_correct=int(correct[1:].sum()),
        dwell_wrong=int(wrong[1:].sum()),
        dwell_start=int(((over[0] | over[1]) & ~correct & ~wrong)[1:].sum()),
        min_distance_correct=least[0],
        min_distance_wrong=least[1],
        closer_to=_choice(gains[0] > gains[1] + TIE, gains[1] > gains[0] + TIE),
        release_near=None if released_at is None else at(released_at),
        correct_side_share=float((towards_correct[1:] > 0).mean()),
        start_side_correct=bool(towards_correct[0] > 0),
    )


def _over(trajectory: Trajectory, side: Side, half: float) -> Flags:
    """Return (T + 1,) whether the hand is over the box around a picture."""
    away = trajectory.tool[:, :3] - trajectory.tile(side)[:, :3]
    return np.asarray((np.abs(away[:, :2]) <= half).all(axis=1) & (away[:, 2] >= HAND_ABOVE))


def _left_where_it_began(over: Flags, away: NDArray[np.float32], moved: float) -> Flags:
    """Return (T + 1,) whether the hand has stayed over a box from the start on without being brought closer."""
    return np.asarray(np.logical_and.accumulate(over) & (away[0] - away < moved))


def _choice(correct: bool, wrong: bool) -> Choice:
    return "correct" if correct else "wrong" if wrong else "none"


def _offset_to_correct_side(trajectory: Trajectory, side_correct: Side) -> NDArray[np.float32]:
    """Return (T + 1,) the metres of the hand beyond the line midway between the pictures' starts.

    They are positive on the correct side.
    """
    correct, wrong = trajectory.tile(side_correct)[0, :2], trajectory.tile(other_side(side_correct))[0, :2]
    middle, towards = (correct + wrong) / 2, (correct - wrong) / np.linalg.norm(correct - wrong)
    return np.asarray((trajectory.tool[:, :2] - middle) @ towards)
