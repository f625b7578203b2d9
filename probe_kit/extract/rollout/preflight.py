"""A test build of the scene, so that errors that affect all episodes are raised before the first one."""

from collections.abc import Iterable
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from probe_kit.env import Act2AnswerEnv, SceneSpec
from probe_kit.errors import SceneError
from probe_kit.extract.plan import PlannedEpisode

EPISODES = 3
"""If the scene of one episode cannot be built, so many are tried: a single one costs no run."""


def run_preflight(scene: SceneSpec, episodes: Iterable[PlannedEpisode]) -> None:
    """Set up the first episode, or the next ones if its start cannot be reached.

    Raises SceneError if none of the first episodes can be set up, such as for an arm whose meshes are not
    installed, and SuiteError if a picture of the first one is not what the suite says.
    """
    env = Act2AnswerEnv(scene)
    failed: SceneError | None = None
    try:
        for planned in islice(episodes, EPISODES):
            try:
                env.reset(
                    seed=planned.scene_seed,
                    options={"item": planned.episode.item, "layout": planned.episode.layout},
                )
            except SceneError as error:
                failed = error
            else:
                return
    finally:
        env.close()
    if failed is not None:
        raise failed


def first_states(scene: SceneSpec, episodes: Iterable[PlannedEpisode]) -> NDArray[np.float32]:
    """(n, 8) states of the arm at the first inference of some episodes; those that cannot be set up are left out.

    Raises SceneError if none can be set up.
    """
    env = Act2AnswerEnv(scene)
    states, failed = [], None
    try:
        for planned in episodes:
            try:
                options = {"item": planned.episode.item, "layout": planned.episode.layout}
                seen, _ = env.reset(seed=planned.scene_seed, options=options)
                states.append(seen["agent_pos"])
            except SceneError as error:
                failed = error
    finally:
        env.close()
    if not states and failed is not None:
        raise failed
    return np.stack(states)
