"""Carrying the cube from any pose of the hand: a rule that corrects every disturbance, and its next action."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from probe_kit.env import Act2AnswerEnv
from probe_kit.env.scripted import CLOSED, MAX_SHIFT, OPEN, RELEASE_GAP
from probe_kit.suite.items import Side

TRAVEL_HEIGHT = 0.12
DESCENT = (0.01, 0.06)
"""Metres from the middle of the tile, seen from above: within the first the hand is down, beyond the second up."""
LETS_GO = (0.02, 0.008)
"""Metres from there within which the hand opens: seen from above, and in height."""
OPENED = 0.7
"""Measured opening of a hand that has let go; around the cube it is 0.53."""


@dataclass(frozen=True)
class Carrying:
    """To one tile. goal: (3,) of the commanded tool when the cube is let go."""

    goal: NDArray[np.float64]

    @classmethod
    def to(cls, env: Act2AnswerEnv, side: Side) -> "Carrying":
        """As the cube lies in the hand of a scene that was just reset."""
        spec, arm = env.scene_spec, env.scene.arm
        hold = env.scene.cube_state().position - env.trial.controller.target.position
        x, y = np.array(env.scene.tile_xy(side)) - hold[:2]
        height = spec.tile_height + max(spec.cube_side / 2 - hold[2], arm.model.clearance) + RELEASE_GAP
        return cls(np.array([x, y, height]))

    def action(self, position: NDArray[np.float64], opened: bool) -> NDArray[np.float64]:
        """(7,) for a commanded tool position: on to the tile and down, or up again once the hand is open."""
        if opened:
            target, gripper = np.array([*position[:2], max(TRAVEL_HEIGHT, position[2])]), OPEN
        else:
            away = float(np.hypot(*(self.goal - position)[:2]))
            up = np.clip((away - DESCENT[0]) / (DESCENT[1] - DESCENT[0]), 0, 1)
            target = np.array([*self.goal[:2], self.goal[2] + up * (TRAVEL_HEIGHT - self.goal[2])])
            at_goal = away < LETS_GO[0] and position[2] - self.goal[2] < LETS_GO[1]
            gripper = OPEN if at_goal else CLOSED
        shift = target - position
        shift *= min(1.0, MAX_SHIFT / max(float(np.linalg.norm(shift)), 1e-9))
        return np.array([*shift, 0.0, 0.0, 0.0, gripper])

    def ahead(self, position: NDArray[np.float64], opened: bool, count: int) -> NDArray[np.float32]:
        """(count, 7), what follows if nothing disturbs it."""
        actions = []
        for _ in range(count):
            actions.append(self.action(position, opened))
            position = position + actions[-1][:3]
        return np.array(actions, np.float32)
