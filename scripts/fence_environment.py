"""An own environment for `fence.py`: a hand moves to a block, which lies left or right; plain arithmetic."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from probe_kit.extract import EnvEpisode, Step
from probe_kit.hooks import Observation

SIDE = 48
EPISODES = 20
MOST_STEPS = 4


class BlockTable:
    """Episodes of four actions; a seed decides where hand and block are."""

    revision = "block-table 1"
    action_names = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")

    def episodes(self) -> Iterator[EnvEpisode]:
        """Yield twenty episodes in ten groups; a group has its block on one side."""
        for seed in range(EPISODES):
            colour = ("red", "blue")[seed % 2]
            yield EnvEpisode(f"block-{seed:02d}", seed, f"Put the cube on the {colour} shape", f"pair-{seed // 2}")

    def reset(self, episode: EnvEpisode) -> Step:
        """Place hand and block."""
        drawn = np.random.default_rng(episode.seed)
        self.instruction, self.steps = episode.instruction, 0
        self.hand = np.array([0.29, 0.0, 0.16]) + 0.01 * drawn.integers(-3, 4, 3)
        self.block = (0.09, -0.09)[episode.seed // 2 % 2] + 0.01 * drawn.integers(-1, 2)
        return self._step()

    def step(self, action: NDArray[np.float32]) -> Step:
        """Move the hand by at most 2 cm along each axis."""
        moved = self.hand + np.clip(action[:3], -0.02, 0.02)
        self.hand = np.clip(moved, [0.2, -0.1, 0.1], [0.4, 0.1, 0.3])
        self.steps += 1
        return self._step()

    def close(self) -> None:
        """Hold nothing open."""

    def _step(self) -> Step:
        away = abs(float(self.hand[1]) - self.block)
        facts = {"block": self.block, "left": self.block > 0, "away": away, "success": away < 0.03}
        state = np.array([*self.hand, 0, 0, 0, 0, 1], np.float32)
        return Step(Observation(self._picture(), state, self.instruction), self.steps == MOST_STEPS, facts)

    def _picture(self) -> NDArray[np.uint8]:
        picture = np.full((SIDE, SIDE, 3), 200, np.uint8)
        for y, colour in ((self.block, (200, 30, 30)), (float(self.hand[1]), (40, 40, 40))):
            column = int(SIDE * (0.5 + 4 * y))
            picture[20:28, max(0, column - 4) : max(0, column + 4)] = colour
        return picture
