from pathlib import Path

import numpy as np
import pybullet_data
import pytest

from probe_kit.env.arm import ARMS
from probe_kit.env.rotations import from_rpy
from probe_kit.env.scene import Scene
from probe_kit.env.spec import SceneSpec
from probe_kit.errors import SceneError

STAY_OPEN = np.array([0, 0, 0, 0, 0, 0, 1.0])


@pytest.fixture
def arm(arm_env):
    arm_env.reset(seed=0)
    return arm_env.scene.arm


def test_the_home_pose_is_where_the_spec_says_and_points_down(arm, arm_env):
    np.testing.assert_allclose(arm.tool_state(), [*arm_env.scene_spec.home, 0, 0, 0], atol=1e-5)


def test_the_measured_angles_are_roll_pitch_yaw_relative_to_pointing_down(arm, arm_env):
    for _ in range(3):
        arm_env.advance(np.array([0, 0, 0, 0.1, -0.05, 0.15, 1.0]))
    arm_env.advance(STAY_OPEN)
    turn = np.linalg.matrix_power(from_rpy([0.1, -0.05, 0.15]), 3)
    np.testing.assert_allclose(from_rpy(arm.tool_state()[3:]), turn, atol=5e-3)


def test_the_tool_follows_a_command_within_a_millimetre(arm, arm_env):
    for _ in range(4):
        arm_env.advance(np.array([0.01, 0.02, -0.01, 0, 0, 0, 1.0]))
    arm_env.advance(STAY_OPEN)
    expected = np.add(arm_env.scene_spec.home, [0.04, 0.08, -0.04])
    np.testing.assert_allclose(arm.tool_state()[:3], expected, atol=1e-3)


def test_the_gripper_closes_and_opens(arm, arm_env):
    assert arm.opening() == pytest.approx(1.0, abs=0.01)
    for _ in range(3):
        arm_env.advance(np.zeros(7))
    assert arm.opening() == pytest.approx(0.0, abs=0.02)
    for _ in range(3):
        arm_env.advance(STAY_OPEN)
    assert arm.opening() == pytest.approx(1.0, abs=0.02)


def test_the_fingers_stay_symmetric(arm, arm_env):
    arm_env.advance(np.zeros(7))
    left, right = (arm_env.scene.client.getJointState(arm.body, f)[0] for f in arm.model.fingers)
    assert left == pytest.approx(right, abs=1e-3)


def test_a_description_of_ones_own_takes_the_place_of_ours(make_env, play):
    theirs = ARMS["panda"].urdf(None)
    assert play(make_env(arm_urdf=theirs, early_stop=True), seed=0) == play(make_env(early_stop=True), seed=0)


def test_a_missing_description_is_named(make_env):
    with pytest.raises(SceneError, match=r"no arm description nowhere\.urdf"):
        make_env(arm_urdf=Path("nowhere.urdf")).reset(seed=0)


def test_a_description_of_another_robot_is_refused(make_env):
    other = Path(pybullet_data.getDataPath()) / "r2d2.urdf"
    with pytest.raises(SceneError, match="does not describe this arm"):
        make_env(arm_urdf=other).reset(seed=0)


@pytest.mark.parametrize("model", ARMS.values(), ids=ARMS)
def test_the_frame_that_points_down_is_a_rotation(model):
    down = np.array(model.down)
    np.testing.assert_allclose(down @ down.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(down) == pytest.approx(1.0)


def test_a_description_that_is_none_is_refused(tmp_path):
    rubbish = tmp_path / "arm.urdf"
    rubbish.write_bytes(b"\x00\xff[[[")
    with pytest.raises(SceneError, match="cannot be read as a robot"):
        Scene(SceneSpec(arm_urdf=rubbish))
