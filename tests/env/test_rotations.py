import numpy as np
import pybullet
import pytest

from probe_kit.env.rotations import from_euler_xyz, from_rpy, to_rpy, to_vector, yaw_quaternion

ANGLES = np.random.default_rng(0).uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (50, 3))


@pytest.mark.parametrize("rpy", ANGLES[:10])
def test_matrices_equal_those_of_pybullet(rpy):
    theirs = pybullet.getMatrixFromQuaternion(pybullet.getQuaternionFromEuler(rpy))
    np.testing.assert_allclose(from_rpy(rpy), np.reshape(theirs, (3, 3)), atol=1e-12)


def test_roll_pitch_yaw_survives_the_round_trip():
    np.testing.assert_allclose([to_rpy(from_rpy(rpy)) for rpy in ANGLES], ANGLES, atol=1e-9)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_gimbal_lock_gives_angles_of_the_same_rotation(pitch):
    R = from_rpy([0.4, pitch, -0.7])
    rpy = to_rpy(R)
    assert rpy[0] == 0.0
    np.testing.assert_allclose(from_rpy(rpy), R, atol=1e-7)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.3, 3.0, np.pi - 1e-7, np.pi])
def test_rotation_vector_is_axis_times_angle(angle):
    axis, skew = np.array([2.0, -1.0, 2.0]) / 3, np.array([[0, -2, -1], [2, 0, -2], [1, 2, 0]]) / 3
    R = np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
    vector = to_vector(R)
    # A half turn about an axis is also one about its opposite.
    sign = np.sign(vector @ axis) if angle == np.pi else 1.0
    np.testing.assert_allclose(sign * vector, angle * axis, atol=1e-6)


def test_yaw_quaternion_turns_x_to_y():
    R = np.reshape(pybullet.getMatrixFromQuaternion(yaw_quaternion(np.pi / 2)), (3, 3))
    np.testing.assert_allclose(R @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_euler_xyz_turns_about_the_axes_in_the_opposite_order():
    for angles in ANGLES[:10]:
        about_x, about_y, about_z = (from_rpy(part) for part in np.diag(angles))
        np.testing.assert_allclose(from_euler_xyz(angles), about_x @ about_y @ about_z, atol=1e-12)
        np.testing.assert_allclose(from_rpy(angles), about_z @ about_y @ about_x, atol=1e-12)
