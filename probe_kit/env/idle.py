"""A policy that does nothing: the success rate that an outcome rule gives without any answer."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.env.act2answer import Act2AnswerEnv


class Idle:
    """Never moves the tool, and leaves the gripper as it was at the start: shut around a cube in hand, else open.

    env: an Act2AnswerEnv, wrapped or not.
    """

    def __init__(self, env: Any) -> None:
        self._env: Act2AnswerEnv = env.unwrapped

    def reset(self) -> None:
        """There is nothing to plan."""

    def act(self) -> NDArray[np.float32]:
        """The next action (7,) float32."""
        return np.array([0, 0, 0, 0, 0, 0, not self._env.scene_spec.start_grasped], np.float32)
