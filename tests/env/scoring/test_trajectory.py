import numpy as np

from probe_kit.env import ScriptedExpert
from probe_kit.env.act2answer import Recorder
from probe_kit.env.scoring import CHANNELS, Trajectory


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
    found, spec = recorder.trajectory(), shared_env.scene_spec
    side = shared_env.question.side_correct
    assert (len(found), found.steps) == (61, 60)
    np.testing.assert_allclose(found.cube[0, :3], (*spec.cube_xy, spec.cube_side / 2), atol=1e-6)
    np.testing.assert_allclose(found.cube[-1, :2], shared_env.outcome().cube_xy, atol=1e-6)
    np.testing.assert_allclose(found.tile(side)[:, :2] - spec.tile_xy(side), 0, atol=1e-6)
    np.testing.assert_allclose(found.tool[-1, :3], shared_env.scene.arm.tool_state()[:3], atol=1e-6)
    assert found.held.any()
    assert not found.held[[0, -1]].any()
    assert (found.finger_force[found.held] > 1).all()
    assert found.touches[-1].tolist() == [side == "left", side == "right"]
    assert found.opening[found.held].max() < 1
    np.testing.assert_allclose(found.executed, found.commanded, atol=1e-6)


def test_what_was_executed_differs_from_what_was_commanded_where_a_limit_stood_in_the_way(shared_env):
    shared_env.reset(seed=0)
    largest = shared_env.scene_spec.limits.translation
    found = recorded(shared_env, [np.array([0, 0.5, 0, 0, 0, 0, 0.7]), np.array([0, -0.02, 0, 0, 0, 0.1, 0.2])])
    assert found.commanded[0, 1] == np.float32(0.5)
    np.testing.assert_allclose(found.executed[0], [0, largest, 0, 0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(found.executed[1], [0, -0.02, 0, 0, 0, 0.1, 0], atol=1e-6)


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
    found = recorded(shared_env, [np.array([0.01, 0, 0, 0, 0, 0, 1.0])] * 3)
    frames = found.frames
    assert frames.shape == (4, len(CHANNELS))
    assert np.isnan(frames[0]).sum() == 15
    again = Trajectory.of_frames(frames)
    np.testing.assert_array_equal(again.frames, frames)
    labelled = found.to_xarray()
    assert labelled["commanded"].sel(step=1, motion="dx") == np.float32(0.01)
    assert labelled["cube"].sel(frame=0, pose="z") == found.cube[0, 2]
    assert frames[0, CHANNELS.index("tile_right.y")] == found.tile_right[0, 1]
