"""Turning points of episodes whose every step is known."""

import json
from dataclasses import replace

import numpy as np
import pytest

from probe_kit.env import ScriptedExpert
from probe_kit.env.act2answer import Recorder
from probe_kit.env.scoring import (
    CHANNELS,
    EVENTS,
    LATERAL,
    MOVED,
    RELEASED_STEPS,
    RULES,
    Box,
    Events,
    Outcome,
    Trajectory,
    behaviour_of,
    judge,
    rule_of,
    success_by_radius,
    zone,
)
from probe_kit.env.spec import SceneSpec
from probe_kit.errors import SceneError, UsageError


def recorded(env, actions) -> Trajectory:
    recorder = Recorder(env)
    for action in actions:
        env.advance(action)
        recorder.note(action)
    return recorder.trajectory()


def test_a_trajectory_says_where_everything_was_and_who_touched_whom(shared_env):
    shared_env.reset(seed=0)
    expert = ScriptedExpert(shared_env)
    expert.reset()
    recorder = Recorder(shared_env)
    while not shared_env.trial.over:
        action = expert.act()
        shared_env.advance(action)
        recorder.note(action)
    motion, spec = recorder.trajectory(), shared_env.scene_spec
    side = shared_env.question.side_correct
    assert (len(motion), motion.steps) == (61, 60)
    np.testing.assert_allclose(motion.cube[0, :3], (*spec.cube_xy, spec.cube_side / 2), atol=1e-6)
    np.testing.assert_allclose(motion.cube[-1, :2], shared_env.outcome().cube_xy, atol=1e-6)
    np.testing.assert_allclose(motion.tile(side)[:, :2] - spec.tile_xy(side), 0, atol=1e-6)
    np.testing.assert_allclose(motion.tool[-1, :3], shared_env.scene.arm.tool_state()[:3], atol=1e-6)
    assert motion.held.any()
    assert not motion.held[[0, -1]].any()
    assert (motion.finger_force[motion.held] > 1).all()
    assert motion.touches[-1].tolist() == [side == "left", side == "right"]
    assert motion.opening[motion.held].max() < 1
    np.testing.assert_allclose(motion.executed, motion.commanded, atol=1e-6)


def test_executed_actions_differ_from_commanded_ones_where_a_limit_acted(shared_env):
    shared_env.reset(seed=0)
    largest = shared_env.scene_spec.limits.translation
    motion = recorded(shared_env, [np.array([0, 0.5, 0, 0, 0, 0, 0.7]), np.array([0, -0.02, 0, 0, 0, 0.1, 0.2])])
    assert motion.commanded[0, 1] == np.float32(0.5)
    np.testing.assert_allclose(motion.executed[0], [0, largest, 0, 0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(motion.executed[1], [0, -0.02, 0, 0, 0, 0.1, 0], atol=1e-6)


def test_looking_does_not_change_what_happens(shared_env):
    actions = [np.array([0.01, 0.02, -0.02, 0, 0, 0.05, 1.0])] * 4
    shared_env.reset(seed=0)
    watched = recorded(shared_env, actions)
    shared_env.reset(seed=0)
    for action in actions:
        shared_env.advance(action)
    assert Recorder(shared_env).trajectory().cube[0].tolist() == watched.cube[-1].tolist()


def test_frames_and_labels_hold_the_same_numbers(shared_env):
    shared_env.reset(seed=0)
    motion = recorded(shared_env, [np.array([0.01, 0, 0, 0, 0, 0, 1.0])] * 3)
    frames = motion.frames
    assert frames.shape == (4, len(CHANNELS))
    assert np.isnan(frames[0]).sum() == 15
    again = Trajectory.of_frames(frames)
    np.testing.assert_array_equal(again.frames, frames)
    labelled = motion.to_xarray()
    assert labelled["commanded"].sel(step=1, motion="dx") == np.float32(0.01)
    assert labelled["cube"].sel(frame=0, pose="z") == motion.cube[0, 2]
    assert frames[0, CHANNELS.index("tile_right.y")] == motion.tile_right[0, 1]


ON_TILE = Outcome(
    zone="correct",
    layout="swapped",
    side_correct="right",
    cube_xy=(0.39, -0.12),
    cube_z=0.021,
    distance_correct=0.06,
    distance_wrong=0.30,
    epsilon=0.065,
    cube_moved=True,
    on_tile=True,
    is_grasped=False,
    steps=23,
    clipped=0,
    truncation_reason=None,
)
NAN = float("nan")


@pytest.mark.parametrize(
    ("correct", "wrong", "expected"),
    [
        (0.0, 0.31, "correct"),
        (0.31, 0.0, "wrong"),
        (0.2, 0.2, "oob"),
        (0.065, 0.25, "correct"),  # the edge is inside
        (0.0651, 0.25, "oob"),
        (NAN, NAN, "oob"),
    ],
)
def test_the_zone_depends_on_both_distances(correct, wrong, expected):
    assert zone(correct, wrong, 0.065) == expected


def test_a_cube_in_both_zones_is_a_configuration_error():
    with pytest.raises(SceneError, match="smaller radius"):
        zone(0.15, 0.15, 0.16)


@pytest.mark.parametrize(("where", "side"), [("correct", "right"), ("wrong", "left"), ("oob", "none")])
def test_the_side_placed_follows_from_the_zone(where, side):
    assert replace(ON_TILE, zone=where).side_placed == side


def test_a_cube_that_never_moved_is_told_apart_inside_out_of_bounds():
    assert replace(ON_TILE, zone="oob", cube_moved=False).never_moved
    assert not replace(ON_TILE, zone="oob", cube_moved=True).never_moved
    assert not replace(ON_TILE, zone="correct", cube_moved=False).never_moved


def test_success_is_scored_again_for_other_radii_from_the_record_alone():
    outcomes = [replace(ON_TILE, distance_correct=d) for d in (0.05, 0.06, 0.07, 0.20)]
    assert success_by_radius(outcomes) == {0.055: 0.25, 0.065: 0.5, 0.081: 0.75}


def test_scoring_nothing_is_an_error():
    with pytest.raises(ValueError, match="at least one"):
        success_by_radius([])


def test_the_record_is_strict_json_even_when_the_simulator_broke():
    broken = replace(ON_TILE, cube_xy=(NAN, NAN), cube_z=NAN, distance_correct=NAN, zone="oob")
    stored = json.loads(json.dumps(broken.to_json(), allow_nan=False))
    assert stored["cube_xy"] == [None, None]
    assert stored["side_placed"] == "none"
    assert stored["steps"] == 23


FRAMES = 12
LEFT_TILE, RIGHT_TILE = (0.4, 0.155), (0.4, -0.155)


def trajectory(tool: np.ndarray, held_frames: list[int]) -> Trajectory:
    """tool: (T + 1, 3) places. held_frames: frames in which the cube is."""
    frames = len(tool)
    pose = np.zeros((frames, 7), np.float32)
    tiles = [pose + np.array([*tile, 0, 0, 0, 0, 1], np.float32) for tile in (LEFT_TILE, RIGHT_TILE)]
    zero = np.zeros(frames, np.float32)
    return Trajectory(
        tool=np.hstack([tool, np.zeros((frames, 3))]).astype(np.float32), opening=zero, cube=pose, cube_speed=zero,
        tile_left=tiles[0], tile_right=tiles[1], finger_force=np.zeros((frames, 2), np.float32),
        held=np.isin(np.arange(frames), held_frames), touches=np.zeros((frames, 2), bool),
        commanded=np.zeros((frames - 1, 7), np.float32), executed=np.zeros((frames - 1, 7), np.float32),
        ik_error=zero[1:],
    )  # fmt: skip


def reaching() -> np.ndarray:
    """Settles, sets off at frame 2 sideways to the cube, lifts it, moves aside from frame 8 on."""
    places = np.zeros((FRAMES, 3))
    places[1, 2] = MOVED / 2
    places[2:, 1] = 0.06
    places[5:, 2] = 0.1
    places[8:, 1] += 1.5 * LATERAL
    return places


def test_every_event_has_the_frame_at_which_it_was_first_the_case() -> None:
    events = Events.of(trajectory(reaching(), held_frames=[4, 5, 7, 8, 9]))
    assert events == Events(first_motion=2, grasp=4, first_lateral_move=8, release=10)
    assert [events.frame(name) for name in EVENTS] == [2, 4, 8, 10]


@pytest.mark.parametrize("side", [-1, 1])
def test_reaching_sideways_for_the_cube_is_no_choice_of_a_side(side: int) -> None:
    places = reaching() * np.array([1, side, 1])
    assert Events.of(trajectory(places, held_frames=[4, 5, 6, 7])).first_lateral_move == 8
    assert Events.of(trajectory(places, held_frames=[])).first_lateral_move is None


def test_an_event_that_never_happened_has_no_frame() -> None:
    assert Events.of(trajectory(np.zeros((FRAMES, 3)), held_frames=[])) == Events(None, None, None, None)


def test_a_cube_that_is_still_held_was_not_released() -> None:
    assert Events.of(trajectory(reaching(), held_frames=list(range(4, FRAMES)))).release is None


@pytest.mark.slow
def test_the_scripted_expert_sets_off_grasps_chooses_a_side_and_lets_go(shared_env) -> None:
    from probe_kit.env import ScriptedExpert
    from probe_kit.env.act2answer import Recorder

    shared_env.reset(seed=0)
    expert = ScriptedExpert(shared_env)
    expert.reset()
    recorder = Recorder(shared_env)
    while not shared_env.trial.over:
        action = expert.act()
        shared_env.advance(action)
        recorder.note(action)
    event_frames = [Events.of(recorder.trajectory()).frame(event) for event in EVENTS]
    assert None not in event_frames
    assert event_frames == sorted(event_frames)
    assert len(set(event_frames)) == len(EVENTS)


SCENE = SceneSpec.preset("act2answer").to_json()
START = (0.2780, -0.0131, 0.1430)
LEFT, RIGHT = np.array((0.397, 0.183, 0.003)), np.array((0.397, -0.127, 0.003))


def episode(
    *cube: tuple[float, float, float],
    left=LEFT,
    right=RIGHT,
    held: bool = False,
    touches: tuple[bool, bool] = (False, False),
    speed: float = 0.0,
) -> Trajectory:
    """The cube at these places, frame by frame; the rest as it is at the end of all frames."""
    frames = np.zeros((len(cube), len(CHANNELS)), np.float32)
    frames[:, [CHANNELS.index(f"cube.{axis}") for axis in "xyz"]] = cube
    for name, centre in (("tile_left", left), ("tile_right", right)):
        frames[:, [CHANNELS.index(f"{name}.{axis}") for axis in "xyz"]] = centre
        frames[:, CHANNELS.index(f"{name}.qw")] = 1
    motion = Trajectory.of_frames(frames)
    ones = np.ones(len(cube), bool)
    return replace(motion, held=ones & held, touches=ones[:, None] & np.array(touches), cube_speed=ones * speed)


def outcomes(motion: Trajectory, side="right") -> list[str]:
    return [judge(motion, rule_of(name, SCENE), side).outcome for name in RULES]


def test_the_untouched_cube_of_the_released_scene_answers_right_by_box_alone():
    """It starts 21 mm from the inner and 16 mm from the near edge of the right picture's box."""
    idle = episode(START, START)
    assert dict(zip(RULES, outcomes(idle, "right"), strict=True)) == {
        "disc": "oob", "box": "correct", "released-on-tile": "oob",
    }  # fmt: skip
    assert outcomes(idle, "left") == ["oob", "wrong", "oob"]
    assert judge(idle, rule_of("box", SCENE), "right").idle == "correct"
    assert judge(idle, rule_of("disc", SCENE), "right").idle == "oob"


def test_rules_have_the_sizes_of_the_scene():
    assert rule_of("disc", SCENE).radius == pytest.approx(0.0826)
    assert rule_of("box", SCENE) == Box(0.135, 0.008)
    assert rule_of("released-on-tile", SCENE).half == pytest.approx(0.0726)
    small = SceneSpec.preset("act2answer", scoring_side=0.088).to_json()
    assert rule_of("box", small).half == pytest.approx(0.124)


def test_a_scene_stored_before_there_were_boxes_has_the_released_one():
    old = {name: value for name, value in SceneSpec().to_json().items() if not name.startswith(("box", "scoring"))}
    assert rule_of("box", old) == Box(0.135, 0.008)


@pytest.mark.parametrize(
    ("cube", "expected"),
    [
        ((0.397 + 0.1349, -0.127 - 0.1349, 0.2), "correct"),
        ((0.397 + 0.1351, -0.127, 0.2), "oob"),
        ((0.397, -0.127 - 0.1351, 0.2), "oob"),
        ((0.397, -0.127, 0.003 + 0.0081), "correct"),
        ((0.397, -0.127, 0.003 + 0.0079), "oob"),
        ((0.30, -0.1, 0.015), "correct"),  # on the bare table beside the picture
        ((0.397, 0.183, 0.021), "wrong"),
        ((0.397, 0.028, 0.015), "oob"),  # in the gap of 4 cm
        ((np.nan, np.nan, np.nan), "oob"),
    ],
)
def test_the_box_ends_where_the_released_one_does(cube, expected):
    assert judge(episode(START, cube), rule_of("box", SCENE), "right").outcome == expected


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "correct"),
        ({"held": True}, "oob"),
        ({"speed": 0.01}, "oob"),
        ({"touches": (False, False)}, "oob"),
        ({"touches": (True, False)}, "oob"),
    ],
)
def test_released_on_tile_asks_that_the_cube_was_let_go_lies_still_and_touches_that_tile(changes, expected):
    end = (0.397 + 0.07, -0.127 + 0.07, 0.021)
    motion = episode(START, end, **{"touches": (False, True), **changes})
    assert judge(motion, rule_of("released-on-tile", SCENE), "right").outcome == expected
    beyond = episode(START, (0.397 + 0.0727, -0.127, 0.021), touches=(False, True))
    assert judge(beyond, rule_of("released-on-tile", SCENE), "right").outcome == "oob"


def test_a_tile_that_was_turned_counts_as_it_lies():
    motion = episode(START, (0.397 + 0.09, -0.127, 0.021), touches=(False, True))
    rule = rule_of("released-on-tile", SCENE)
    assert judge(motion, rule, "right").outcome == "oob"
    turned = np.array(motion.tile_right)
    turned[:, 3:] = (0, 0, np.sin(np.pi / 8), np.cos(np.pi / 8))  # 45 degrees: its corner points there
    assert judge(replace(motion, tile_right=turned), rule, "right").outcome == "correct"


def test_a_pushed_tile_counts_where_it_is_at_the_end():
    pushed = RIGHT + np.array((0.1, 0, 0))
    motion = episode(START, (0.5, -0.127, 0.021), right=pushed, touches=(False, True))
    assert outcomes(motion) == ["correct"] * 3
    stayed = episode(START, (0.5, -0.127, 0.021), touches=(False, False))
    assert outcomes(stayed) == ["oob", "correct", "oob"]


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_cube_in_both_boxes_counts_for_the_correct_one_and_is_flagged(side):
    nearer = np.array((0, 0.03, 0))
    motion = episode(START, (0.397, 0.028, 0.015), left=LEFT - nearer, right=RIGHT + nearer)
    verdict = judge(motion, rule_of("box", SCENE), side)
    assert (verdict.outcome, verdict.both, verdict.correct, verdict.wrong) == ("correct", True, 1.0, 0.0)
    assert not judge(episode(START, START), rule_of("box", SCENE), side).both


def test_the_mean_over_the_last_eleven_steps_counts_every_one_alike():
    """Eighty steps: over the correct picture in the last four."""
    motion = episode(START, *[(0.6, 0, 0.1)] * 76, *[(0.397, -0.127, 0.1)] * 4)
    verdict = judge(motion, rule_of("box", SCENE), "right", RELEASED_STEPS, 80)
    assert (verdict.correct, verdict.wrong, verdict.oob) == (4 / 11, 0, pytest.approx(7 / 11))
    assert verdict.outcome == "correct"
    with pytest.raises(UsageError, match="at least 1"):
        judge(motion, rule_of("box", SCENE), "right", 0)


def test_an_episode_that_ended_early_stays_as_it_was_until_the_last_step():
    motion = episode(START, *[(0.6, 0, 0.1)] * 6, *[(0.397, -0.127, 0.1)] * 2)
    assert judge(motion, rule_of("box", SCENE), "right", 11, 80).correct == 1
    assert judge(motion, rule_of("box", SCENE), "right", 4, 8).correct == 0.5
    assert judge(motion, rule_of("box", SCENE), "right", 99, 8).correct == 2 / 8


def test_an_unknown_rule_is_named_with_the_nearest():
    with pytest.raises(UsageError, match="did you mean box"):
        rule_of("boxx", SCENE)


HOME = (0.2921, -0.0061, 0.1349)  # of the released scene: over the right picture's box
GAP = (0.2921, 0.028, 0.15)
ABOVE_LEFT, ABOVE_RIGHT = (0.397, 0.183, 0.1), (0.397, -0.127, 0.1)


def hand(*places: tuple[float, float, float], held: tuple[int, ...] = ()) -> Trajectory:
    frames = np.zeros((len(places), len(CHANNELS)), np.float32)
    for name, centre in (("tile_left", ABOVE_LEFT), ("tile_right", ABOVE_RIGHT)):
        frames[:, [CHANNELS.index(f"{name}.{axis}") for axis in "xyz"]] = (*centre[:2], 0.003)
    frames[:, [CHANNELS.index(f"tool.{axis}") for axis in "xyz"]] = places
    frames[:, [CHANNELS.index(f"cube.{axis}") for axis in "xyz"]] = places
    motion = Trajectory.of_frames(frames)
    return replace(motion, held=np.isin(np.arange(len(places)), held))


def of(motion: Trajectory, side="left"):
    return behaviour_of(motion, side, 0.135, 0.03)


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
    there_and_back = of(hand(HOME, HOME, GAP, ABOVE_LEFT, ABOVE_LEFT, GAP, ABOVE_RIGHT, held=(0, 1, 2, 3)), side)
    assert there_and_back.first_choice == first
    assert there_and_back.release_near == first
    dwell = {"left": (2, 1), "right": (1, 2)}[side]
    assert (there_and_back.dwell_correct, there_and_back.dwell_wrong, there_and_back.dwell_start) == (*dwell, 1)
    returned = of(hand(HOME, GAP, ABOVE_RIGHT), side)
    assert returned.first_choice == ("wrong" if side == "left" else "correct")


def test_the_box_in_which_the_hand_began_counts_when_it_is_brought_closer():
    straight = of(
        hand(HOME, (0.31, -0.02, 0.1), (0.35, -0.07, 0.1), ABOVE_RIGHT, ABOVE_RIGHT, held=(0, 1, 2, 3)), "right"
    )
    assert (straight.first_choice, straight.release_near) == ("correct", "correct")
    assert (straight.dwell_correct, straight.dwell_start) == (3, 1)


def test_a_hand_that_jumps_from_one_box_into_the_other_chose_that_one():
    """The gap between them is 4 cm, less than an action may move the hand."""
    jumped = of(hand(HOME, (0.2921, 0.06, 0.13), ABOVE_LEFT), "left")
    assert (jumped.first_choice, jumped.dwell_correct, jumped.dwell_start) == ("correct", 2, 0)


def test_closer_to_is_what_was_gained_since_the_start():
    """Half way to the left the hand is still as near to the right picture as to the left one."""
    towards_left = of(hand(HOME, (0.2921, 0.03, 0.13)), "left")
    assert towards_left.closer_to == "correct"
    assert towards_left.min_distance_wrong < towards_left.min_distance_correct + 0.02
    assert of(hand(HOME, (0.2921, 0.03, 0.13)), "right").closer_to == "wrong"


def test_distances_are_of_the_whole_episode_and_a_broken_simulator_hides_none():
    behaviour = of(hand(HOME, ABOVE_LEFT, HOME, (np.nan, np.nan, np.nan)), "left")
    assert behaviour.min_distance_correct == pytest.approx(0, abs=1e-6)
    assert behaviour.furthest == pytest.approx(np.hypot(0.397 - 0.2921, 0.183 + 0.0061), abs=1e-6)
    assert behaviour.moved
