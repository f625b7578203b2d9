import numpy as np

STAY_OPEN = np.array([0, 0, 0, 0, 0, 0, 1.0])


def test_an_untouched_cube_is_out_of_bounds_and_never_moved(make_env):
    env = make_env(max_steps=3)
    env.reset(seed=0)
    while not env.trial.over:
        env.advance(STAY_OPEN)
    outcome = env.outcome()
    assert outcome.zone == "oob"
    assert outcome.never_moved
    assert (outcome.steps, outcome.truncation_reason) == (3, "max_steps")


def test_a_cube_that_leaves_the_table_ends_the_episode(shared_env):
    shared_env.reset(seed=0)
    scene = shared_env.scene
    scene.client.resetBasePositionAndOrientation(scene.cube, (0.25, 0.9, 0.0), (0, 0, 0, 1))
    steps = 0
    truncated = False
    while not truncated:
        _, terminated, truncated, info = shared_env.advance(STAY_OPEN)
        steps += 1
    assert not terminated
    assert steps < 4
    assert (info["truncation_reason"], info["outcome"]) == ("cube_fell", "oob")
    assert shared_env.outcome().cube_moved


def test_a_broken_simulator_ends_the_episode_and_the_next_one_is_fine(make_env):
    env = make_env()
    env.reset(seed=0)
    env.scene.client.resetBasePositionAndOrientation(env.scene.cube, (np.nan,) * 3, (0, 0, 0, 1))
    _, _, truncated, info = env.advance(STAY_OPEN)
    assert truncated
    assert (info["truncation_reason"], info["outcome"]) == ("non_finite", "oob")
    _, info = env.reset(seed=0)
    np.testing.assert_allclose(info["cube_xy"], env.scene_spec.cube_xy)


def test_clipped_actions_are_counted(shared_env):
    shared_env.reset(seed=0)
    for shift in (0.0, 0.5, 0.02, 0.5):
        shared_env.advance(np.array([0, shift, 0, 0, 0, 0, 1.0]))
    assert shared_env.outcome().clipped == 2


def test_pushing_the_cube_moves_it(shared_env):
    shared_env.reset(seed=0)
    for action in [(-0.08, 0.028, 0), (0, 0, -0.10), (0, 0, -0.04), *[(0.05, 0, 0)] * 2]:
        shared_env.advance(np.array([*action, 0, 0, 0, 0.0]))
    outcome = shared_env.outcome()
    assert outcome.cube_moved
    assert not outcome.is_grasped


def test_early_stop_ends_five_actions_after_the_release(make_env, play):
    late, early = play(make_env(), seed=0), play(make_env(early_stop=True), seed=0)
    assert (late.steps, late.truncation_reason) == (60, "max_steps")
    assert early.steps < 30
    assert early.truncation_reason is None
    np.testing.assert_allclose(early.cube_xy, late.cube_xy, atol=1e-4)


def test_early_stop_waits_for_a_cube_that_was_never_grasped(make_env):
    env = make_env(early_stop=True, max_steps=12)
    env.reset(seed=0)
    ends = [env.advance(STAY_OPEN)[1:3] for _ in range(12)]
    assert ends == [(False, False)] * 11 + [(False, True)]


def test_the_flags_follow_the_cube_through_an_episode(make_env):
    from probe_kit.env import ScriptedExpert

    env = make_env(early_stop=True)
    env.reset(seed=0)
    expert = ScriptedExpert(env)
    expert.reset()
    infos = []
    while not env.trial.over:
        infos.append(env.advance(expert.act())[3])
    grasped = [info["is_grasped"] for info in infos]
    assert not grasped[0]
    assert any(grasped)
    assert not grasped[-1]
    assert infos[-1]["on_tile"]
    assert max(info["cube_z"] for info in infos) > 0.1
