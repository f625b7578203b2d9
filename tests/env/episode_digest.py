"""Print one hash over all states and some frames of an expert episode, for comparison across processes."""

import hashlib
import sys
from importlib.util import find_spec

import numpy as np

from probe_kit.env import Act2AnswerEnv, SceneSpec, ScriptedExpert


def digest(env: Act2AnswerEnv, seed: int) -> str:
    """Hex sha256 of joints, cube pose and speed after every action, and of every fifth observation."""
    hasher = hashlib.sha256()
    observation, _ = env.reset(seed=seed)
    expert = ScriptedExpert(env)
    expert.reset()
    while not env.trial.over:
        hasher.update(env.scene.arm.joints().tobytes())
        cube = env.scene.cube_state()
        hasher.update(np.concatenate([cube.position, cube.quaternion, [cube.speed]]).tobytes())
        if env.trial.steps % 5 == 0:
            observation = env.observe()
            hasher.update(observation["pixels"]["image"].tobytes() + observation["agent_pos"].tobytes())
        env.advance(expert.act())
    return hasher.hexdigest()


def released_digest(env: Act2AnswerEnv, seed: int, look: bool = False) -> str:
    """Likewise of all bodies that move, in an episode of the released protocol that presses a tile and pushes it.

    look: draw a picture after every action.
    """
    walk = np.random.default_rng(seed).uniform(-0.02, 0.02, (10, 7))
    down = [(0.02, 0.19, -0.06, 0, 0, 0, 0), (0, 0, -0.055, 0, 0, 0, 0)]
    hasher = hashlib.sha256(env.reset(seed=seed)[0]["pixels"]["image"].tobytes())
    for action in [*down, *walk]:
        env.advance(action)
        scene = env.scene
        for state in (scene.cube_state(), scene.tile_state("left"), scene.tile_state("right")):
            hasher.update(state.position.tobytes() + state.quaternion.tobytes())
        hasher.update(scene.arm.joints().tobytes())
        if look:
            env.observe()
    hasher.update(env.observe()["pixels"]["image"].tobytes())
    return hasher.hexdigest()


def make_released_env() -> Act2AnswerEnv:
    """The scene of the released protocol; an episode ends with the cube."""
    return Act2AnswerEnv(SceneSpec.preset("act2answer", early_stop=True))


def make_env() -> Act2AnswerEnv:
    """The default scene with a random start."""
    return Act2AnswerEnv(SceneSpec(start_jitter=0.02, start_jitter_yaw=3.14, early_stop=True))


if __name__ == "__main__":
    print("digest", digest(make_env(), int(sys.argv[1])))
    if find_spec("rtbdata") is not None:
        print("released", released_digest(make_released_env(), int(sys.argv[1])))
