import numpy as np
import pytest

from probe_kit.env.rotations import Pose, SerialChain, from_rpy


@pytest.fixture
def arm(arm_env):
    arm_env.reset(seed=0)
    return arm_env.scene.arm


@pytest.fixture
def postures(arm):
    random = np.random.default_rng(1)
    return random.uniform(arm.chain.lower, arm.chain.upper, (20, len(arm.model.joints)))


def test_a_planar_arm_of_two_links_agrees_with_trigonometry():
    chain = SerialChain(
        axes=np.array([[0.0, 0.0, 1.0]] * 2),
        points=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        tip=Pose(np.array([1.5, 0.0, 0.0]), np.eye(3)),
        lower=np.full(2, -3.0),
        upper=np.full(2, 3.0),
    )
    pose = chain.pose(np.array([0.4, 0.7]))
    x, y = np.cos(0.4) + 0.5 * np.cos(1.1), np.sin(0.4) + 0.5 * np.sin(1.1)
    np.testing.assert_allclose(pose.position, [x, y, 0.0], atol=1e-12)
    np.testing.assert_allclose(pose.rotation, from_rpy([0, 0, 1.1]), atol=1e-12)


def test_forward_kinematics_equal_those_of_pybullet(arm, postures, arm_env):
    client = arm_env.scene.client
    for q in postures:
        arm.set_joints(q, 1.0)
        state = client.getLinkState(arm.body, arm.model.tool, computeForwardKinematics=True)
        pose = arm.chain.pose(q)
        np.testing.assert_allclose(pose.position, state[4], atol=1e-6)
        theirs = np.reshape(client.getMatrixFromQuaternion(state[5]), (3, 3))
        np.testing.assert_allclose(pose.rotation, theirs, atol=1e-6)


def test_jacobian_equals_finite_differences(arm, postures):
    q, step = postures[0], 1e-6
    for joint, column in enumerate(arm.chain.pose_and_jacobian(q)[1].T):
        nudge = step * np.eye(len(q))[joint]
        ahead, behind = arm.chain.pose(q + nudge), arm.chain.pose(q - nudge)
        velocity = (ahead.position - behind.position) / (2 * step)
        spin = (ahead.rotation - behind.rotation) / (2 * step) @ arm.chain.pose(q).rotation.T
        np.testing.assert_allclose(column[:3], velocity, atol=1e-6)
        np.testing.assert_allclose(column[3:], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-6)


def test_inverse_kinematics_reach_every_place_of_the_workspace(arm, arm_env):
    home, posture = arm_env.scene.home_q, np.array(arm.model.posture)
    random = np.random.default_rng(2)
    for position in random.uniform([0.2, -0.25, 0.02], [0.45, 0.25, 0.3], (20, 3)):
        turn = from_rpy([0, 0, random.uniform(-0.7, 0.7)])
        target = Pose(position, turn @ np.array(arm.model.down))
        solution = arm.chain.solve(target, home, posture, iterations=100)
        reached = arm.chain.pose(solution.q)
        np.testing.assert_allclose(reached.position, position, atol=2e-5)
        np.testing.assert_allclose(reached.rotation, target.rotation, atol=2e-5)


def test_a_small_step_needs_only_a_few_iterations(arm, arm_env):
    home, posture = arm_env.scene.home_q, np.array(arm.model.posture)
    pose = arm.chain.pose(home)
    target = Pose(np.add(pose.position, [0.01, 0.02, -0.01]), pose.rotation)
    assert arm.chain.solve(target, home, posture, iterations=4).error < 1e-5


def test_a_redundant_arm_does_not_wander_off_when_the_tool_goes_round_in_circles(shared_env):
    shared_env.reset(seed=0)
    chain, home = shared_env.scene.arm.chain, shared_env.scene.home_q
    centre, q = chain.pose(home), home
    for angle in np.linspace(0, 10 * np.pi, 250):
        offset = 0.1 * np.array([np.cos(angle) - 1, np.sin(angle), 0])
        q = chain.solve(Pose(centre.position + offset, centre.rotation), q, home).q
    np.testing.assert_allclose(q, home, atol=0.1)


def test_an_unreachable_place_is_reported_by_its_error(arm, arm_env):
    home = arm_env.scene.home_q
    target = Pose(np.array([5.0, 0.0, 0.3]), np.array(arm.model.down))
    solution = arm.chain.solve(target, home, np.array(arm.model.posture))
    assert solution.error > 3.5
    assert (solution.q >= arm.chain.lower).all()
    assert (solution.q <= arm.chain.upper).all()
