import numpy as np
import pytest

from probe_kit.env import LimitSpec
from probe_kit.env.arm import DeltaController, check_action
from probe_kit.env.rotations import from_euler_xyz, from_rpy
from probe_kit.errors import ActionError


@pytest.fixture
def controller(shared_env):
    shared_env.reset(seed=0)
    return shared_env.trial.controller


def action(shift=(0, 0, 0), turn=(0, 0, 0), gripper=1.0):
    return np.array([*shift, *turn, gripper], float)


@pytest.mark.parametrize(
    ("bad", "complaint"),
    [
        (np.zeros(6), r"shape \(6,\)"),
        (np.zeros((1, 7)), r"one action of a chunk"),
        (0.0, r"shape \(\)"),
        ([0, 0, 0, 0, 0, 0, np.nan], "not finite"),
        ([np.inf, 0, 0, 0, 0, 0, 0], "not finite"),
        (["left"] * 7, "not numeric"),
        ([None] * 7, "not finite"),
        (np.array([{}] * 7, object), "not numeric"),
    ],
)
def test_bad_actions_are_refused_with_the_reason(bad, complaint):
    with pytest.raises(ActionError, match=complaint):
        check_action(bad)


def test_deltas_accumulate_on_the_commanded_pose(controller, shared_env):
    for _ in range(5):
        controller.command(action((0.01, -0.02, 0.005)))
    np.testing.assert_allclose(controller.target.position, np.add(shared_env.scene_spec.home, [0.05, -0.1, 0.025]))


def test_a_turn_keeps_the_tool_in_place(controller):
    before = controller.target.position
    controller.command(action(turn=(0.2, 0.1, -0.3)))
    np.testing.assert_array_equal(controller.target.position, before)


def test_the_gripper_opens_above_one_half(controller):
    openings = [controller.command(action(gripper=g)).opening for g in (-1.0, 0.0, 0.5, 0.51, 1.0, 7.0)]
    assert openings == [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]


def test_a_huge_delta_is_clipped_per_axis_and_said_so(controller, shared_env):
    move = controller.command(action((0.0, 5.0, 0.02), turn=(0, 0, 3.0)))
    assert move.clipped
    np.testing.assert_allclose(controller.target.position - shared_env.scene_spec.home, [0, 0.10, 0.02], atol=1e-5)


def test_an_ordinary_action_is_not_called_clipped(controller):
    assert not controller.command(action((0.03, -0.02, 0.01), (0.1, 0, 0.2))).clipped


def test_the_commanded_pose_stays_in_the_workspace_and_off_the_table(controller, shared_env):
    moves = [controller.command(action((-0.1, 0.1, -0.1))) for _ in range(6)]
    assert moves[-1].clipped
    x, y, z = controller.target.position
    assert (x, y) == (shared_env.scene_spec.limits.low[0], shared_env.scene_spec.limits.high[1])
    assert z == shared_env.scene.arm.model.clearance


def test_an_unreachable_pose_holds_the_arm_and_the_command(shared_env):
    from dataclasses import replace

    shared_env.reset(seed=0)
    scene = shared_env.scene
    far = replace(shared_env.scene_spec.limits, translation=5.0, high=(9.0, 9.0, 9.0))
    controller = DeltaController(scene.arm, far, scene.home_q)
    before = controller.target
    move = controller.command(action((5.0, 0, 0)))
    assert move.ik_error > 3.0
    assert controller.target is before
    np.testing.assert_array_equal(move.q_to, scene.home_q)


def test_what_really_moved_is_told_after_limits_and_out_of_reach(controller):
    move = controller.command(action((0.01, 5.0, 0.02), turn=(0.1, 0, 3.0)))
    np.testing.assert_allclose(move.shift, [0.01, 0.10, 0.02])
    np.testing.assert_allclose(move.turn, [0.1, 0, 0.5])
    held = [controller.command(action((0.1, 0, 0), turn=(0, 0.5, 0))) for _ in range(8)][-1]
    assert held.ik_error > 0 or held.clipped
    np.testing.assert_array_equal(held.q_to, held.q_from)
    np.testing.assert_array_equal([*held.shift, *held.turn], np.zeros(6))


def test_without_limits_an_action_is_carried_out_whole_and_nothing_keeps_the_hand_off_the_table(shared_env):
    shared_env.reset(seed=0)
    scene = shared_env.scene
    controller = DeltaController(scene.arm, LimitSpec.off(), scene.home_q)
    before = controller.target.position
    moves = [controller.command(action(shift)) for shift in ((0.02, 0.15, 0), (0, 0, -0.17))]
    assert not any(move.clipped for move in moves)
    np.testing.assert_allclose(controller.target.position - before, [0.02, 0.15, -0.17], atol=1e-4)
    assert controller.target.position[2] < 0


@pytest.mark.parametrize(("euler", "rotation"), [("zyx", from_rpy), ("xyz", from_euler_xyz)])
def test_the_rotation_of_an_action_is_read_in_the_order_of_the_scene(euler, rotation, shared_env):
    shared_env.reset(seed=0)
    scene, turn = shared_env.scene, (0.3, -0.2, 0.4)
    controller = DeltaController(scene.arm, LimitSpec(), scene.home_q, euler)
    before = controller.target.rotation
    controller.command(action(turn=turn))
    np.testing.assert_allclose(controller.target.rotation, rotation(turn) @ before, atol=1e-12)
