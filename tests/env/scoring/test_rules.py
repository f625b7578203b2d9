from dataclasses import replace

import numpy as np
import pytest

from probe_kit.env.scoring import CHANNELS, RELEASED_STEPS, RULES, Box, Trajectory, judge, rule_of
from probe_kit.env.spec import SceneSpec
from probe_kit.errors import UsageError

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
    for name, place in (("tile_left", left), ("tile_right", right)):
        frames[:, [CHANNELS.index(f"{name}.{axis}") for axis in "xyz"]] = place
        frames[:, CHANNELS.index(f"{name}.qw")] = 1
    seen = Trajectory.of_frames(frames)
    ones = np.ones(len(cube), bool)
    return replace(seen, held=ones & held, touches=ones[:, None] & np.array(touches), cube_speed=ones * speed)


def outcomes(seen: Trajectory, side="right") -> list[str]:
    return [judge(seen, rule_of(name, SCENE), side).outcome for name in RULES]


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
    place = (0.397 + 0.07, -0.127 + 0.07, 0.021)
    seen = episode(START, place, **{"touches": (False, True), **changes})
    assert judge(seen, rule_of("released-on-tile", SCENE), "right").outcome == expected
    beyond = episode(START, (0.397 + 0.0727, -0.127, 0.021), touches=(False, True))
    assert judge(beyond, rule_of("released-on-tile", SCENE), "right").outcome == "oob"


def test_a_tile_that_was_turned_counts_as_it_lies():
    seen = episode(START, (0.397 + 0.09, -0.127, 0.021), touches=(False, True))
    rule = rule_of("released-on-tile", SCENE)
    assert judge(seen, rule, "right").outcome == "oob"
    turned = np.array(seen.tile_right)
    turned[:, 3:] = (0, 0, np.sin(np.pi / 8), np.cos(np.pi / 8))  # 45 degrees: its corner points there
    assert judge(replace(seen, tile_right=turned), rule, "right").outcome == "correct"


def test_a_pushed_tile_counts_where_it_is_at_the_end():
    pushed = RIGHT + np.array((0.1, 0, 0))
    seen = episode(START, (0.5, -0.127, 0.021), right=pushed, touches=(False, True))
    assert outcomes(seen) == ["correct"] * 3
    stayed = episode(START, (0.5, -0.127, 0.021), touches=(False, False))
    assert outcomes(stayed) == ["oob", "correct", "oob"]


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_cube_in_both_boxes_counts_for_the_correct_one_and_is_flagged(side):
    nearer = np.array((0, 0.03, 0))
    seen = episode(START, (0.397, 0.028, 0.015), left=LEFT - nearer, right=RIGHT + nearer)
    verdict = judge(seen, rule_of("box", SCENE), side)
    assert (verdict.outcome, verdict.both, verdict.correct, verdict.wrong) == ("correct", True, 1.0, 0.0)
    assert not judge(episode(START, START), rule_of("box", SCENE), side).both


def test_the_mean_over_the_last_eleven_steps_counts_every_one_alike():
    """Eighty steps: over the correct picture in the last four."""
    seen = episode(START, *[(0.6, 0, 0.1)] * 76, *[(0.397, -0.127, 0.1)] * 4)
    verdict = judge(seen, rule_of("box", SCENE), "right", RELEASED_STEPS, 80)
    assert (verdict.correct, verdict.wrong, verdict.oob) == (4 / 11, 0, pytest.approx(7 / 11))
    assert verdict.outcome == "correct"
    with pytest.raises(UsageError, match="at least 1"):
        judge(seen, rule_of("box", SCENE), "right", 0)


def test_an_episode_that_ended_early_stays_as_it_was_until_the_last_step():
    seen = episode(START, *[(0.6, 0, 0.1)] * 6, *[(0.397, -0.127, 0.1)] * 2)
    assert judge(seen, rule_of("box", SCENE), "right", 11, 80).correct == 1
    assert judge(seen, rule_of("box", SCENE), "right", 4, 8).correct == 0.5
    assert judge(seen, rule_of("box", SCENE), "right", 99, 8).correct == 2 / 8


def test_an_unknown_rule_is_named_with_the_nearest():
    with pytest.raises(UsageError, match="did you mean box"):
        rule_of("boxx", SCENE)
