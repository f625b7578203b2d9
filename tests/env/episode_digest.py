"""Print one hash over all states and some frames of an expert episode, for comparison across processes."""

import hashlib
import sys

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


def make_env() -> Act2AnswerEnv:
    """The default scene with a random start."""
    return Act2AnswerEnv(SceneSpec(start_jitter=0.02, start_jitter_yaw=3.14, early_stop=True))


if __name__ == "__main__":
    print("digest", digest(make_env(), int(sys.argv[1])))
