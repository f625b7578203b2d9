import numpy as np
import pytest

from probe_kit.env import ScriptedExpert
from probe_kit.env.arm import ARMS
from probe_kit.errors import EpisodeOverError

RANDOM_START = {"start_jitter": 0.02, "start_jitter_yaw": np.pi, "early_stop": True}
EPISODES = [4, pytest.param(60, marks=pytest.mark.slow)]


@pytest.fixture
def play_many(make_env, play):
    def run(count, mirrored=False, preset="bridge", **changes):
        env = make_env(preset, **(RANDOM_START | changes))
        layouts = ("original", "swapped")
        return [play(env, seed, layouts[seed % 2], mirrored) for seed in range(count)]

    return run


@pytest.mark.slow
@pytest.mark.parametrize("count", EPISODES)
@pytest.mark.parametrize("preset", ["bridge", "frontal"])
@pytest.mark.parametrize("arm", ARMS)
def test_the_expert_puts_every_cube_in_the_middle_of_the_correct_tile(count, preset, arm, play_many):
    outcomes = play_many(count, preset=preset, arm=arm)
    assert [o.zone for o in outcomes] == ["correct"] * count
    # The cliff: a grip that is too strong for the solver squeezes the cube out or drops it beside its place.
    assert max(o.distance_correct for o in outcomes) < 0.005
    assert all(o.on_tile and not o.is_grasped for o in outcomes)


@pytest.mark.slow
@pytest.mark.parametrize("arm", ARMS)
def test_a_hundred_random_episodes_are_all_correct(arm, play_many):
    outcomes = play_many(100, arm=arm)
    assert sum(o.is_success for o in outcomes) == 100
    assert max(o.distance_correct for o in outcomes) < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("count", EPISODES)
def test_the_mirrored_expert_answers_every_question_wrong(count, play_many):
    outcomes = play_many(count, mirrored=True)
    assert [o.zone for o in outcomes] == ["wrong"] * count
    assert {o.side_placed for o in outcomes} == {"left", "right"}


@pytest.mark.slow
@pytest.mark.parametrize("tile_side", [0.088, 0.154])
def test_the_expert_succeeds_on_smaller_and_larger_tiles(tile_side, play_many):
    assert all(o.is_success for o in play_many(2, tile_side=tile_side))


@pytest.mark.slow
@pytest.mark.parametrize("arm", ARMS)
def test_an_episode_that_starts_with_the_cube_in_hand_is_half_as_long(arm, play_many):
    grasped, plain = play_many(4, arm=arm, start_grasped=True), play_many(4, arm=arm)
    assert all(o.is_success and o.distance_correct < 0.005 for o in grasped)
    assert np.mean([o.steps for o in grasped]) < 0.7 * np.mean([o.steps for o in plain])


def test_the_expert_stays_within_the_action_space(shared_env):
    shared_env.reset(seed=0)
    expert = ScriptedExpert(shared_env)
    expert.reset()
    while not shared_env.trial.over:
        action = expert.act()
        assert shared_env.action_space.contains(action)
        shared_env.advance(action)
    assert shared_env.outcome().clipped == 0


def test_the_reward_comes_once_with_the_last_action(make_env):
    env = make_env(early_stop=True)
    env.reset(seed=0)
    expert = ScriptedExpert(env)
    expert.reset()
    rewards = []
    while not env.trial.over:
        reward, terminated, truncated, info = env.advance(expert.act())
        rewards.append(reward)
    assert (terminated, truncated, info["is_success"], info["outcome"]) == (True, False, True, "correct")
    assert rewards[-1] == sum(rewards) == 1.0


def test_an_expert_without_a_plan_says_so(shared_env):
    with pytest.raises(EpisodeOverError, match="no plan"):
        ScriptedExpert(shared_env).act()
