""""""

import re
import shutil
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data
import pytest
from numpy.typing import NDArray

from probe_kit.env import Act2AnswerEnv, LimitSpec
from probe_kit.env import arm as arm_module
from probe_kit.env.arm import ARMS, DeltaController, check_action, write_urdf
from probe_kit.env.rotations import Pose, SerialChain, from_euler_xyz, from_rpy, to_rpy, to_vector, yaw_quaternion
from probe_kit.env.scene import Scene
from probe_kit.env.simulation import BulletClient, Camera
from probe_kit.env.spec import CameraSpec, LightSpec, SceneSpec
from probe_kit.errors import ActionError, SceneError


@pytest.fixture
def robot(tmp_path):
    pytest.importorskip("rtbdata")
    client = BulletClient()
    yield client, client.loadURDF(str(write_urdf(tmp_path)), useFixedBase=True)
    client.close()


def test_the_home_pose_of_simplerenv_puts_the_tool_where_it_was_measured(robot):
    client, body = robot
    # SimplerEnv's description turns the forearm the other way round: elbow, roll, wrist and rotate change sign.
    home = (-0.01840777, 0.0398835, -0.22242722, 0.00460194, -1.36524296, -0.00153398)
    for joint, angle in enumerate(home):
        client.resetJointState(body, joint, angle)
    position = client.getLinkState(body, 8, computeForwardKinematics=True)[4]
    np.testing.assert_allclose(position, [0.292, -0.006, 0.135], atol=2e-3)


def test_it_has_six_turning_joints_and_two_fingers(robot):
    client, body = robot
    kinds = [client.getJointInfo(body, joint)[2] for joint in range(client.getNumJoints(body))]
    assert kinds == [client.JOINT_REVOLUTE] * 6 + [client.JOINT_PRISMATIC] * 2 + [client.JOINT_FIXED]


def test_every_link_that_should_be_seen_has_a_mesh(robot):
    client, body = robot
    drawn = {shape[1] for shape in client.getVisualShapeData(body) if Path(shape[4].decode()).is_file()}
    assert drawn == set(range(-1, 8))


def test_missing_meshes_are_announced_with_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(arm_module, "find_spec", lambda _: None)
    with pytest.raises(SceneError, match=r"Install `rtb-data"):
        write_urdf(tmp_path)


def test_another_version_of_the_meshes_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(arm_module, "MESH_FOLDER", Path("elsewhere"))
    pytest.importorskip("rtbdata")
    with pytest.raises(SceneError, match="not version 2"):
        write_urdf(tmp_path)


@pytest.fixture
def simulated_arm(arm_env):
    arm_env.reset(seed=0)
    return arm_env.scene.arm


@pytest.fixture
def postures(simulated_arm):
    random = np.random.default_rng(1)
    return random.uniform(
        simulated_arm.chain.lower, simulated_arm.chain.upper, (20, len(simulated_arm.model.joints))
    )


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


def test_forward_kinematics_equal_those_of_pybullet(simulated_arm, postures, arm_env):
    client = arm_env.scene.client
    for q in postures:
        simulated_arm.set_joints(q, 1.0)
        state = client.getLinkState(simulated_arm.body, simulated_arm.model.tool, computeForwardKinematics=True)
        pose = simulated_arm.chain.pose(q)
        np.testing.assert_allclose(pose.position, state[4], atol=1e-6)
        theirs = np.reshape(client.getMatrixFromQuaternion(state[5]), (3, 3))
        np.testing.assert_allclose(pose.rotation, theirs, atol=1e-6)


def test_jacobian_equals_finite_differences(simulated_arm, postures):
    q, step = postures[0], 1e-6
    for joint, column in enumerate(simulated_arm.chain.pose_and_jacobian(q)[1].T):
        nudge = step * np.eye(len(q))[joint]
        ahead, behind = simulated_arm.chain.pose(q + nudge), simulated_arm.chain.pose(q - nudge)
        velocity = (ahead.position - behind.position) / (2 * step)
        spin = (ahead.rotation - behind.rotation) / (2 * step) @ simulated_arm.chain.pose(q).rotation.T
        np.testing.assert_allclose(column[:3], velocity, atol=1e-6)
        np.testing.assert_allclose(column[3:], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-6)


def test_inverse_kinematics_reach_every_place_of_the_workspace(simulated_arm, arm_env):
    home, posture = arm_env.scene.home_q, np.array(simulated_arm.model.posture)
    random = np.random.default_rng(2)
    for position in random.uniform([0.2, -0.25, 0.02], [0.45, 0.25, 0.3], (20, 3)):
        turn = from_rpy([0, 0, random.uniform(-0.7, 0.7)])
        target = Pose(position, turn @ np.array(simulated_arm.model.down))
        solution = simulated_arm.chain.solve(target, home, posture, iterations=100)
        reached = simulated_arm.chain.pose(solution.q)
        np.testing.assert_allclose(reached.position, position, atol=2e-5)
        np.testing.assert_allclose(reached.rotation, target.rotation, atol=2e-5)


def test_a_small_step_needs_only_a_few_iterations(simulated_arm, arm_env):
    home, posture = arm_env.scene.home_q, np.array(simulated_arm.model.posture)
    pose = simulated_arm.chain.pose(home)
    target = Pose(np.add(pose.position, [0.01, 0.02, -0.01]), pose.rotation)
    assert simulated_arm.chain.solve(target, home, posture, iterations=4).error < 1e-5


def test_a_redundant_arm_does_not_wander_off_when_the_tool_goes_round_in_circles(shared_env):
    shared_env.reset(seed=0)
    chain, home = shared_env.scene.arm.chain, shared_env.scene.home_q
    centre, q = chain.pose(home), home
    for angle in np.linspace(0, 10 * np.pi, 250):
        offset = 0.1 * np.array([np.cos(angle) - 1, np.sin(angle), 0])
        q = chain.solve(Pose(centre.position + offset, centre.rotation), q, home).q
    np.testing.assert_allclose(q, home, atol=0.1)


def test_an_unreachable_place_is_reported_by_its_error(simulated_arm, arm_env):
    home = arm_env.scene.home_q
    target = Pose(np.array([5.0, 0.0, 0.3]), np.array(simulated_arm.model.down))
    solution = simulated_arm.chain.solve(target, home, np.array(simulated_arm.model.posture))
    assert solution.error > 3.5
    assert (solution.q >= simulated_arm.chain.lower).all()
    assert (solution.q <= simulated_arm.chain.upper).all()


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


@pytest.mark.slow
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


@pytest.fixture
def copied_arm(tmp_path: Path) -> Path:
    """The description of a copy of the Panda whose meshes a test may change."""
    folder = shutil.copytree(Path(pybullet_data.getDataPath()) / "franka_panda", tmp_path / "arm")
    urdf = folder / "panda.urdf"
    urdf.write_text(urdf.read_text(encoding="utf-8").replace("package://", f"{folder}/"), encoding="utf-8")
    return urdf


def enlarge_hand(urdf: Path) -> None:
    for mesh in (urdf.parent / "meshes").rglob("hand.obj"):
        grown = re.sub(r"^v (\S+) (\S+) (\S+)", lambda v: "v " + " ".join(str(2 * float(x)) for x in v.groups()),
                       mesh.read_text(encoding="utf-8"), flags=re.MULTILINE)  # fmt: skip
        mesh.write_text(grown, encoding="utf-8")


@pytest.mark.parametrize("change", ["mesh", "material", "texture"])
def test_a_scene_is_another_once_a_file_of_its_arm_changed(copied_arm: Path, change: str) -> None:
    before = SceneSpec(arm_urdf=copied_arm).to_json()
    assert SceneSpec(arm_urdf=copied_arm).to_json() == before
    if change == "mesh":
        enlarge_hand(copied_arm)
    else:
        material = next((copied_arm.parent / "meshes" / "visual").glob("hand.mtl"))
        material.write_text(f"{material.read_text(encoding='utf-8')}\nmap_Kd colour.png\n", encoding="utf-8")
        picture = material.with_name("colour.png")
        picture.write_bytes(b"one")
        if change == "texture":
            before = SceneSpec(arm_urdf=copied_arm).to_json()
            picture.write_bytes(b"two")
    after = SceneSpec(arm_urdf=copied_arm).to_json()
    assert [name for name in after if after[name] != before[name]] == ["arm_urdf"]
    with pytest.raises(SceneError, match="Give that file"):
        SceneSpec.from_json(before, {"arm_urdf": copied_arm})


def test_an_edited_mesh_is_drawn_in_the_same_process(copied_arm: Path) -> None:
    def picture() -> NDArray[np.uint8]:
        env = Act2AnswerEnv(SceneSpec(arm_urdf=copied_arm))
        env.reset(seed=0)
        drawn = env.render()
        env.close()
        return drawn

    before = picture()
    enlarge_hand(copied_arm)
    after = picture()
    assert (before != after).any()
    fresh = shutil.copytree(copied_arm.parent, copied_arm.parent.with_name("fresh")) / "panda.urdf"
    fresh.write_text(
        fresh.read_text(encoding="utf-8").replace(f"{copied_arm.parent}/", f"{fresh.parent}/"), encoding="utf-8"
    )
    copied_arm = fresh  # a name that PyBullet never read in this process
    np.testing.assert_array_equal(picture(), after)


def test_a_scene_with_a_users_arm_leaves_the_file_cache_on_for_later_scenes(copied_arm: Path) -> None:
    """PyBullet keeps the setting for the whole process, although a server sets it."""

    def drawn_bodies() -> NDArray[np.int32]:
        client, beside_the_hand = BulletClient(), CameraSpec(eye=(0.7, 0.0, 0.9), forward=(-1.0, 0.0, 0.0))
        client.loadURDF(str(copied_arm), useFixedBase=True)
        bodies = Camera(beside_the_hand).render(client, LightSpec(), 1.0).bodies
        client.close()
        return bodies

    Scene(SceneSpec(arm_urdf=copied_arm)).close()
    before = drawn_bodies()
    assert (before >= 0).any()
    enlarge_hand(copied_arm)
    np.testing.assert_array_equal(drawn_bodies(), before, "the meshes were read again")


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
    report = [controller.command(action((0.1, 0, 0), turn=(0, 0.5, 0))) for _ in range(8)][-1]
    assert report.ik_error > 0 or report.clipped
    np.testing.assert_array_equal(report.q_to, report.q_from)
    np.testing.assert_array_equal([*report.shift, *report.turn], np.zeros(6))


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
