"""Behaviour of hand and cube in one episode, computed from a stored trajectory.

The start biases some of it. In the released scene the hand starts over the right picture's box, so that every
answer to the right is also the "first choice", and it is nearer to the right picture before it has moved. What the
start gave is therefore left out (first choice, dwell, closer to, release) or named beside it (side of the start).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.env.scoring.rules import Flags
from probe_kit.env.scoring.trajectory import Trajectory
from probe_kit.suite.items import Side, other_side

Choice = Literal["correct", "wrong", "none"]

HAND_ABOVE = 0.02
"""How far above the middle of a tile the tool must be to count as over it, metres (the released evaluation's)."""


@dataclass(frozen=True)
class Behaviour:
    """One episode. Metres, shares from 0 to 1, control steps; None where there is nothing to say.

    grasped, released: both fingers ever touched the cube, and let go of it after that. released_at: frame of the
    first release. moved: the cube was ever further than `SceneSpec.moved` from its start, seen from above.
    furthest: how far it was at most.
    hand_starts_over, hand_starts_nearer: which picture the hand is over, and nearer to, before the first action.
    first_choice: the picture whose box the hand was brought into first. The box it began in counts from when the
    hand is nearer to that picture by more than `SceneSpec.moved`, or was away and came back.
    dwell_correct, dwell_wrong: steps over either box, counted likewise; dwell_start: what is left out so.
    min_distance_correct, min_distance_wrong: of the hand, seen from above, over the whole episode.
    closer_to: to which picture the hand came closer than it was at the start, by the larger gain.
    release_near: the picture whose box the hand was over at the first release, counted likewise; None if it
    released nothing.
    correct_side_share: share of steps with the hand on the correct side of the line between the pictures.
    start_side_correct: whether it began on that side.
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
    """Describe the behaviour in one episode; box_half, moved: as in the scene, metres."""
    sides: tuple[Side, Side] = (side_correct, other_side(side_correct))
    over = [_over(trajectory, side, box_half) for side in sides]
    distances = [np.hypot(*(trajectory.tool[:, :2] - trajectory.tile(side)[:, :2]).T) for side in sides]
    correct, wrong = (
        over_picture & ~_left_where_it_began(over_picture, away, moved)
        for over_picture, away in zip(over, distances, strict=True)
    )
    start, least = [float(away[0]) for away in distances], [_least(away) for away in distances]
    furthest = _furthest(trajectory)
    released_at = _first_release(trajectory.held)
    towards_correct = _offset_to_correct_side(trajectory, side_correct)
    return Behaviour(
        grasped=bool(trajectory.held.any()),
        released=released_at is not None,
        released_at=released_at,
        moved=furthest > moved,
        furthest=furthest,
        hand_starts_over=_choice(bool(over[0][0]), bool(over[1][0])),
        hand_starts_nearer=_choice(start[0] < start[1], start[1] < start[0]),
        first_choice=_first(correct, wrong),
        dwell_correct=int(correct[1:].sum()),
        dwell_wrong=int(wrong[1:].sum()),
        dwell_start=int(((over[0] | over[1]) & ~correct & ~wrong)[1:].sum()),
        min_distance_correct=least[0],
        min_distance_wrong=least[1],
        closer_to=_larger(start[0] - least[0], start[1] - least[1]),
        release_near=_release_near(correct, wrong, released_at),
        correct_side_share=float((towards_correct[1:] > 0).mean()),
        start_side_correct=bool(towards_correct[0] > 0),
    )


def _over(trajectory: Trajectory, side: Side, half: float) -> Flags:
    """(T + 1,) whether the hand is over the box around a picture."""
    away = trajectory.tool[:, :3] - trajectory.tile(side)[:, :3]
    return np.asarray((np.abs(away[:, :2]) <= half).all(axis=1) & (away[:, 2] >= HAND_ABOVE))


def _left_where_it_began(over: Flags, away: NDArray[np.float32], moved: float) -> Flags:
    """(T + 1,) the frames of an uninterrupted stay from the start on in which the hand was not brought closer."""
    return np.asarray(np.logical_and.accumulate(over) & (away[0] - away < moved))


def _first(correct: Flags, wrong: Flags) -> Choice:
    entered = np.flatnonzero(correct | wrong)
    return "none" if entered.size == 0 else _choice(bool(correct[entered[0]]), bool(wrong[entered[0]]))


def _choice(correct: bool, wrong: bool) -> Choice:
    return "correct" if correct else "wrong" if wrong else "none"


def _larger(correct: float, wrong: float, tie: float = 1e-3) -> Choice:
    """Gains within a millimetre of each other are none."""
    return _choice(correct > wrong + tie, wrong > correct + tie)


def _first_release(grasped: Flags) -> int | None:
    let_go = np.flatnonzero(grasped[:-1] & ~grasped[1:])
    return None if let_go.size == 0 else int(let_go[0]) + 1


def _release_near(correct: Flags, wrong: Flags, at: int | None) -> Choice | None:
    return None if at is None else _choice(bool(correct[at]), bool(wrong[at]))


def _least(distance: NDArray[np.float32]) -> float:
    """The smallest that is a number: the simulator may break in mid-episode, not before."""
    return float(np.nanmin(distance))


def _furthest(trajectory: Trajectory) -> float:
    return float(np.nanmax(np.hypot(*(trajectory.cube[:, :2] - trajectory.cube[0, :2]).T)))


def _offset_to_correct_side(trajectory: Trajectory, side_correct: Side) -> NDArray[np.float32]:
    """(T + 1,) how far the hand is on the correct side of the line midway between where the pictures began."""
    correct, wrong = trajectory.tile(side_correct)[0, :2], trajectory.tile(other_side(side_correct))[0, :2]
    middle, towards = (correct + wrong) / 2, (correct - wrong) / np.linalg.norm(correct - wrong)
    return np.asarray((trajectory.tool[:, :2] - middle) @ towards)
