"""The same seed gives the same episode, bit for bit, on one machine with one build of the simulator."""

import sys
from importlib.util import find_spec
from subprocess import run

import numpy as np
import pytest

from probe_kit.env import ScriptedExpert
from tests.env import episode_digest


@pytest.fixture(scope="module")
def reference():
    env = episode_digest.make_env()
    yield episode_digest.digest(env, seed=3)
    env.close()


@pytest.fixture
def env():
    env = episode_digest.make_env()
    yield env
    env.close()


@pytest.mark.slow
def test_other_episodes_in_between_leave_no_trace(env, reference):
    assert episode_digest.digest(env, seed=4) != reference
    assert episode_digest.digest(env, seed=3) == reference


@pytest.mark.slow
@pytest.mark.parametrize("actions", [0, 1, 12])
def test_an_episode_broken_off_in_the_middle_leaves_no_trace(actions, env, reference):
    """After 1 action the cube still touches the table, after 12 it is in the hand."""
    env.reset(seed=5)
    expert = ScriptedExpert(env)
    expert.reset()
    for _ in range(actions):
        env.advance(expert.act())
    assert env.scene.is_grasped() == (actions == 12)
    assert episode_digest.digest(env, seed=3) == reference


def test_an_untouched_cube_rests_at_the_same_place_bit_for_bit(env):
    stay = np.array([0, 0, 0, 0, 0, 0, 1.0])
    places = []
    for _ in range(4):
        env.reset(seed=3)
        places.append(env.advance(stay)[3]["cube_xy"].tobytes())
    assert len(set(places)) == 1


@pytest.mark.slow
def test_a_reload_of_the_whole_scene_changes_nothing(env, reference):
    env.reset(seed=0)
    env.scene._build()
    assert episode_digest.digest(env, seed=3) == reference


@pytest.mark.slow
def test_another_environment_in_the_same_process_changes_nothing(env, reference):
    neighbour = episode_digest.make_env()
    neighbour.reset(seed=9)
    assert episode_digest.digest(env, seed=3) == reference
    neighbour.close()


@pytest.mark.slow
def test_a_new_process_gives_the_same_episode(reference):
    command = [sys.executable, episode_digest.__file__, "3"]
    output = run(command, capture_output=True, encoding="utf-8", check=True).stdout
    assert f"digest {reference}" in output
    if find_spec("rtbdata") is not None:
        env = episode_digest.make_released_env()
        assert f"released {episode_digest.released_digest(env, seed=3)}" in output
        env.close()


@pytest.mark.slow
def test_the_seed_moves_the_cube_and_nothing_else_does(env):
    starts = [env.reset(seed=seed)[1]["cube_xy"].tolist() for seed in (1, 2, 1)]
    assert starts[0] == starts[2] != starts[1]
    following = [env.reset()[1]["cube_xy"].tolist() for _ in range(2)]
    assert following[0] != following[1]
