"""The released protocol: what `act2answer-release.md` measured in it, and that our copy of it holds."""

import numpy as np
import pytest

from probe_kit.env import Act2AnswerEnv, Idle, SceneSpec, ScriptedExpert
from probe_kit.env.arm import ARMS
from probe_kit.env.rotations import to_rpy
from probe_kit.env.scene import Scene
from probe_kit.env.simulation import Camera
from probe_kit.errors import SceneError
from tests.env import episode_digest

SPEC = SceneSpec.preset("act2answer")
STAY_OPEN, STAY_SHUT = ([0.0] * 6 + [gripper] for gripper in (1.0, 0.0))
SIDES = ("left", "right")


@pytest.fixture(scope="module")
def env():
    """It stops early, which only an episode whose cube was let go can notice."""
    pytest.importorskip("rtbdata")
    env = episode_digest.make_released_env()
    yield env
    env.close()


@pytest.fixture(scope="module")
def panda_env():
    """The Panda starts from the same pose of its tool."""
    env = Act2AnswerEnv(SceneSpec.preset("act2answer", arm="panda", early_stop=True))
    yield env
    env.close()


@pytest.fixture(params=["env", "panda_env"])
def arm_env(request):
    """The preset with each arm."""
    return request.getfixturevalue(request.param)


def released(x, y, z):
    """Their world in ours: the base of the robot is the origin, half a turn about z."""
    return 0.147 - x, 0.028 - y, z - 0.870


def test_every_place_is_that_of_the_release_in_our_frame():
    np.testing.assert_allclose(released(-0.25, -0.155, 0.87)[:2], SPEC.tile_left)
    np.testing.assert_allclose(released(-0.25, 0.155, 0.87)[:2], SPEC.tile_right)
    np.testing.assert_allclose(released(-0.131, 0.0411, 1.013), (*SPEC.cube_xy, SPEC.cube_z))


@pytest.mark.slow
def test_the_home_joints_lead_where_they_lead_in_the_release(env):
    env.reset(seed=0)
    scene = env.scene
    pose = scene.arm.chain.pose(scene.home_q)
    np.testing.assert_allclose(pose.position, (0.2921, -0.0061, 0.1349), atol=6e-5)
    turn = pose.rotation @ np.array(scene.arm.model.down).T
    np.testing.assert_allclose(to_rpy(turn), (-0.0045, 0.0568, -0.0190), atol=6e-5)
    assert np.degrees(np.arccos(turn[2, 2])) == pytest.approx(3.25, abs=0.02)


def test_joints_that_do_not_lead_home_are_refused():
    pytest.importorskip("rtbdata")
    mirrored = (*SPEC.home_joints[:3], -SPEC.home_joints[3], SPEC.home_joints[4], -SPEC.home_joints[5])
    with pytest.raises(SceneError, match=r"1\.\d mm and 0\.\d+ rad from home"):
        Scene(SceneSpec.preset("act2answer", rendering="raw", home_joints=mirrored))
    with pytest.raises(SceneError, match="7 angles; the widowx has 6 joints"):
        Scene(SceneSpec.preset("act2answer", rendering="raw", home_joints=(*SPEC.home_joints, 0.0)))


def margins(side):
    """Pixels from the corners of each tile to the nearest edge of the frame, below zero outside of it."""
    camera, nearest = Camera(SPEC.camera), []
    for xy in (SPEC.tile_left, SPEC.tile_right):
        corners = [
            (*np.add(xy, (dx, dy)), SPEC.tile_height)
            for dx in (-side / 2, side / 2)
            for dy in (-side / 2, side / 2)
        ]
        pixels = camera.project(corners)
        nearest.append(min(pixels.min(), (np.array([640, 480]) - pixels).min()))
    return nearest


@pytest.mark.parametrize(
    ("side", "left", "right"), [(0.1452, 91, 10.6), (0.1162, 100, 31.6), (0.2033, 59, -30.6), (0.11, 102, 36)]
)
def test_tiles_lie_as_far_from_the_edge_of_the_picture_as_in_the_release(side, left, right):
    np.testing.assert_allclose(margins(side), (left, right), atol=1.0)


@pytest.mark.slow
def test_most_of_both_pictures_is_seen_in_the_first_frame(arm_env):
    visible = arm_env.reset(seed=0)[1]["tile_visibility"]
    assert visible["left"] == pytest.approx(0.958, abs=0.02)
    assert visible["right"] == 1.0


def test_the_cube_is_in_the_hand_and_stays_there(arm_env):
    arm_env.reset(seed=0)
    scene = arm_env.scene
    assert scene.is_grasped()
    start = scene.cube_state().position
    np.testing.assert_allclose(start, (0.2776, -0.0064, 0.1422), atol=2e-3)
    assert not arm_env.trial.over
    for _ in range(5):
        arm_env.advance(STAY_SHUT)
    np.testing.assert_allclose(scene.cube_state().position, start, atol=1e-4)


def test_the_gripper_stays_shut_for_fifteen_actions_whatever_is_asked(env):
    env.reset(seed=0)
    grasped, executed = [], []
    for _ in range(17):
        env.advance(STAY_OPEN)
        grasped.append(env.scene.is_grasped())
        executed.append(env.trial.executed[6])
    assert grasped == [True] * 15 + [False] * 2
    assert executed == [0.0] * 15 + [1.0] * 2
    assert env.scene.cube_state().position[2] < 0.03


@pytest.mark.slow
def test_an_episode_has_eighty_actions_and_nothing_clips_them(env):
    env.reset(seed=0)
    for step in range(80):
        assert not env.trial.over
        env.advance([0.12 * (-1) ** step, 0, 0, 0, 0, 0.6 * (-1) ** step, 0])
    assert env.trial.over
    assert env.outcome().clipped == 0
    assert env.action_space.high[:6].tolist() == pytest.approx([1.0] * 3 + [np.pi] * 3)


def ram_the_table_and_the_left_tile(env):
    for action in ((0.09, 0.1, -0.05), (0, 0, -0.06), (0, 0, -0.1), *[(0.04, 0.02, 0)] * 3):
        env.advance([*action, 0, 0, 0, 0])


def test_a_tile_can_be_pushed_and_takes_its_picture_along(env):
    env.reset(seed=0)
    before = {side: env.scene.tile_state(side).position for side in SIDES}
    for action in ((0.02, 0.19, -0.06), (0, 0, -0.055), *[(0.04, 0, 0)] * 3):
        env.advance([*action, 0, 0, 0, 0])
    moved = {side: env.scene.tile_state(side).position - before[side] for side in SIDES}
    assert moved["left"][0] > 0.02
    assert np.abs(moved["right"]).max() < 1e-4
    xy = env.scene.tile_xy("left")
    assert env.outcome().distance_correct == pytest.approx(np.hypot(*np.subtract(xy, env.outcome().cube_xy)))
    env.observe()
    quad, _ = env.scene.client.getBasePositionAndOrientation(env.scene.quads["left"])
    np.testing.assert_allclose(quad[:2], xy, atol=1e-4)


def test_tiles_are_as_heavy_as_theirs(env):
    env.reset(seed=0)
    client = env.scene.client
    assert [client.getDynamicsInfo(env.scene.tiles[side], -1)[0] for side in SIDES] == [0.81, 0.81]


@pytest.mark.slow
def test_pushed_tiles_and_a_rammed_table_leave_no_trace_in_the_next_episode(env):
    """Contacts of tiles that can be pushed survive a restored state, unless they wait elsewhere in it."""
    reference = episode_digest.released_digest(env, seed=3)
    env.reset(seed=0)
    ram_the_table_and_the_left_tile(env)
    assert episode_digest.released_digest(env, seed=3) == reference
    assert episode_digest.released_digest(env, seed=4) != reference
    assert episode_digest.released_digest(env, seed=3, look=True) == reference, "looking moves the pictures alone"


@pytest.mark.slow
@pytest.mark.parametrize("start_jitter", [pytest.param(0.0, marks=pytest.mark.slow), 0.003])
@pytest.mark.parametrize("arm", ARMS)
def test_a_hand_that_closed_before_holds_the_cube_as_one_that_closes_now(arm, start_jitter, make_env):
    """Closing is simulated once per place of the cube; random actions behind it tell any difference."""
    env = make_env("act2answer", arm=arm, start_jitter=start_jitter)
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 7)) * [0.03, 0.03, 0.03, 0.1, 0.1, 0.1, 1]

    def moved(seed):
        env.reset(seed=seed)
        places = [env.scene.cube_state().position]
        for action in actions:
            env.advance(action)
            places += [env.scene.cube_state().position, env.scene.arm.joints()]
        return np.concatenate(places).tobytes()

    first, other = moved(0), moved(1)
    assert moved(1) == other
    assert moved(0) == first
    env.scene._reload()
    assert moved(0) == first
    assert moved(0) == first


@pytest.mark.parametrize("mirrored", [pytest.param(False, marks=pytest.mark.slow), True])
def test_the_expert_puts_the_cube_on_the_tile_from_the_same_pose_with_either_arm(mirrored, arm_env):
    for seed, layout in enumerate(("original", "swapped")):
        arm_env.reset(seed=seed, options={"layout": layout})
        expert = ScriptedExpert(arm_env, mirrored)
        expert.reset()
        while not arm_env.trial.over:
            arm_env.advance(expert.act())
        outcome = arm_env.outcome()
        assert outcome.zone == ("wrong" if mirrored else "correct")
        assert outcome.on_tile
        assert not outcome.is_grasped
        assert min(outcome.distance_correct, outcome.distance_wrong) < 0.006


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes", [{}, {"start_jitter": 0.003, "start_jitter_yaw": 0.1}, {"tile_side": 0.2033}, {"tile_side": 0.1162}]
)
@pytest.mark.parametrize("arm", ARMS)
def test_a_hundred_episodes_of_the_expert_are_all_correct(arm, changes, make_env, play):
    env = make_env("act2answer", arm=arm, early_stop=True, **changes)
    outcomes = [play(env, seed, ("original", "swapped")[seed % 2]) for seed in range(100)]
    assert sum(o.is_success and o.on_tile and not o.is_grasped for o in outcomes) == 100
    assert max(o.distance_correct for o in outcomes) < 0.010


@pytest.mark.slow
def test_the_idle_policy_leaves_the_cube_inside_the_box_of_the_right_tile(arm_env):
    """It answers under the rule of the release and under none of the others."""
    arm_env.reset(seed=0)
    idle = Idle(arm_env)
    idle.reset()
    for _ in range(17):
        arm_env.advance(idle.act())
    outcome, spec = arm_env.outcome(), arm_env.scene_spec
    assert (outcome.zone, outcome.cube_moved, outcome.is_grasped) == ("oob", False, True)
    inside = {
        side: np.abs(np.subtract(outcome.cube_xy, spec.tile_xy(side))).max() <= spec.box_half for side in SIDES
    }
    assert inside == {"left": False, "right": True}


def test_the_idle_policy_leaves_an_empty_hand_open(shared_env):
    shared_env.reset(seed=0)
    assert Idle(shared_env).act().tolist() == STAY_OPEN
