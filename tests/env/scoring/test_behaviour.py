from dataclasses import replace

import numpy as np
import pytest

from probe_kit.env.scoring import CHANNELS, Trajectory, behaviour_of

HOME = (0.2921, -0.0061, 0.1349)  # of the released scene: over the right picture's box
GAP = (0.2921, 0.028, 0.15)
LEFT, RIGHT = (0.397, 0.183, 0.1), (0.397, -0.127, 0.1)


def hand(*places: tuple[float, float, float], held: tuple[int, ...] = ()) -> Trajectory:
    frames = np.zeros((len(places), len(CHANNELS)), np.float32)
    for name, place in (("tile_left", LEFT), ("tile_right", RIGHT)):
        frames[:, [CHANNELS.index(f"{name}.{axis}") for axis in "xyz"]] = (*place[:2], 0.003)
    frames[:, [CHANNELS.index(f"tool.{axis}") for axis in "xyz"]] = places
    frames[:, [CHANNELS.index(f"cube.{axis}") for axis in "xyz"]] = places
    seen = Trajectory.of_frames(frames)
    return replace(seen, held=np.isin(np.arange(len(places)), held))


def of(seen: Trajectory, side="left"):
    return behaviour_of(seen, side, 0.135, 0.03)


@pytest.mark.parametrize(("side", "over"), [("left", "wrong"), ("right", "correct")])
def test_a_hand_that_does_nothing_chose_nothing_though_it_starts_over_a_picture(side, over):
    idle = of(hand(*[HOME] * 10, held=tuple(range(10))), side)
    assert (idle.hand_starts_over, idle.hand_starts_nearer) == (over, over)
    assert (idle.first_choice, idle.closer_to, idle.release_near) == ("none", "none", None)
    assert (idle.dwell_correct, idle.dwell_wrong, idle.dwell_start) == (0, 0, 9)
    assert (idle.grasped, idle.moved, idle.released) == (True, False, False)
    assert (idle.correct_side_share, idle.start_side_correct) == (float(side == "right"), side == "right")


def test_a_cube_dropped_where_it_started_was_not_released_near_a_picture():
    dropped = of(hand(*[HOME] * 6, held=(0, 1, 2)), "right")
    assert (dropped.released, dropped.released_at, dropped.release_near) == (True, 3, "none")


@pytest.mark.parametrize(("side", "first"), [("left", "correct"), ("right", "wrong")])
def test_the_box_in_which_the_hand_began_counts_when_it_comes_back(side, first):
    there_and_back = of(hand(HOME, HOME, GAP, LEFT, LEFT, GAP, RIGHT, held=(0, 1, 2, 3)), side)
    assert there_and_back.first_choice == first
    assert there_and_back.release_near == first
    dwell = {"left": (2, 1), "right": (1, 2)}[side]
    assert (there_and_back.dwell_correct, there_and_back.dwell_wrong, there_and_back.dwell_start) == (*dwell, 1)
    returned = of(hand(HOME, GAP, RIGHT), side)
    assert returned.first_choice == ("wrong" if side == "left" else "correct")


def test_the_box_in_which_the_hand_began_counts_when_it_is_brought_closer():
    straight = of(hand(HOME, (0.31, -0.02, 0.1), (0.35, -0.07, 0.1), RIGHT, RIGHT, held=(0, 1, 2, 3)), "right")
    assert (straight.first_choice, straight.release_near) == ("correct", "correct")
    assert (straight.dwell_correct, straight.dwell_start) == (3, 1)


def test_a_hand_that_jumps_from_one_box_into_the_other_chose_that_one():
    """The gap between them is 4 cm, less than an action may move the hand."""
    jumped = of(hand(HOME, (0.2921, 0.06, 0.13), LEFT), "left")
    assert (jumped.first_choice, jumped.dwell_correct, jumped.dwell_start) == ("correct", 2, 0)


def test_closer_to_is_what_was_gained_since_the_start():
    """Half way to the left the hand is still as near to the right picture as to the left one."""
    towards_left = of(hand(HOME, (0.2921, 0.03, 0.13)), "left")
    assert towards_left.closer_to == "correct"
    assert towards_left.min_distance_wrong < towards_left.min_distance_correct + 0.02
    assert of(hand(HOME, (0.2921, 0.03, 0.13)), "right").closer_to == "wrong"


def test_distances_are_of_the_whole_episode_and_a_broken_simulator_hides_none():
    seen = of(hand(HOME, LEFT, HOME, (np.nan, np.nan, np.nan)), "left")
    assert seen.min_distance_correct == pytest.approx(0, abs=1e-6)
    assert seen.furthest == pytest.approx(np.hypot(0.397 - 0.2921, 0.183 + 0.0061), abs=1e-6)
    assert seen.moved
