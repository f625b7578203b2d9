"""Observations in the formats of other toolkits, and pictures as a GIF."""

import numpy as np
import pytest
from PIL import Image

from probe_kit.env import ScriptedExpert
from probe_kit.env.arm import ARMS
from probe_kit.env.scripted import save_gif, to_lerobot, to_openpi
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


@pytest.mark.slow
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


@pytest.fixture
def observation():
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (480, 640, 3), np.uint8)
    return {"pixels": {"image": image}, "agent_pos": random.random(8, np.float32)}


def test_names_and_values_equal_those_lerobot_makes_itself(observation):
    theirs = pytest.importorskip("lerobot.envs.utils").preprocess_observation(observation)
    ours = to_lerobot(observation)
    assert set(ours) == set(theirs)
    for name, value in ours.items():
        np.testing.assert_array_equal(value[None], theirs[name].numpy())


def test_batches_of_a_vector_environment_keep_their_first_dimension():
    batch = {"pixels": {"image": np.zeros((4, 480, 640, 3), np.uint8)}, "agent_pos": np.zeros((4, 8))}
    shapes = {name: value.shape for name, value in to_lerobot(batch).items()}
    assert shapes == {"observation.images.image": (4, 3, 480, 640), "observation.state": (4, 8)}


def test_openpi_gets_the_whole_picture_padded_to_a_square(observation):
    observation["pixels"]["image"][:] = 200
    request = to_openpi(observation, "Put the cube on the cat")
    image = request["observation/image"]
    assert (image.shape, image.dtype) == ((224, 224, 3), np.uint8)
    rows = image.any(axis=(1, 2))
    assert (rows.sum(), rows[:28].any(), rows[-28:].any()) == (168, False, False)
    assert request["prompt"] == "Put the cube on the cat"
    np.testing.assert_array_equal(request["observation/state"], observation["agent_pos"])


def test_a_recording_has_every_picture_and_plays_in_real_time(tmp_path):
    pictures = [np.full((48, 64, 3), shade, np.uint8) for shade in (0, 90, 180, 250)]
    save_gif(tmp_path / "episode.gif", pictures, fps=5)
    with Image.open(tmp_path / "episode.gif") as gif:
        assert (gif.n_frames, gif.size, gif.info["duration"], gif.info["loop"]) == (4, (64, 48), 200, 0)
        gif.seek(2)
        assert gif.convert("RGB").getpixel((5, 5)) == (180, 180, 180)


def test_a_recording_of_nothing_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="no pictures"):
        save_gif(tmp_path / "empty.gif", [])
    assert not (tmp_path / "empty.gif").exists()
