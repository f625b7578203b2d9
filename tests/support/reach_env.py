"""A small Gymnasium environment, and its 30 lines behind the contract of `extract --env`."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from probe_kit.extract import EnvEpisode, Step
from probe_kit.hooks import Observation

SIDE = 48


class Reach(gym.Env[dict[str, Any], np.ndarray]):
    """A hand on a table moves by the action to a block, which lies left or right."""

    action_space = gym.spaces.Box(-1, 1, (7,), np.float32)
    observation_space = gym.spaces.Dict(
        pixels=gym.spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8), agent_pos=gym.spaces.Box(-1, 2, (8,), np.float32)
    )

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Place hand and block by the seed."""
        super().reset(seed=seed, options=options)
        self.hand = np.array([0.29, 0.0, 0.16]) + 0.002 * self.np_random.normal(size=3)
        self.block = (-1) ** (seed or 0) * 0.09 + 0.002 * self.np_random.normal()
        self.steps = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Move the hand; eight steps at most."""
        self.hand = np.clip(self.hand + np.clip(action[:3], -0.02, 0.02), [0.2, -0.1, 0.1], [0.4, 0.1, 0.3])
        self.steps += 1
        away = abs(self.hand[1] - self.block)
        return self._observation(), -away, away < 0.02, self.steps == 8, {"away": away, "is_success": away < 0.02}

    def _observation(self) -> dict[str, Any]:
        picture = np.full((SIDE, SIDE, 3), 200, np.uint8)
        for position, colour in ((self.block, (200, 30, 30)), (self.hand[1], (40, 40, 40))):
            column = int(SIDE * (0.5 + 4 * position))
            picture[20:28, max(0, column - 4) : max(0, column + 4)] = colour
        state = np.array([*self.hand, 0, 0, 0, 0, 1], np.float32)
        return {"pixels": picture, "agent_pos": state}


class ReachEnv:
    """`Reach` behind the contract."""

    revision = "reach 1"
    action_names = ("dx", "dy", "dz", "roll", "pitch", "yaw", "grip")

    def __init__(self, count: int | str = 12) -> None:
        self._count, self._env = int(count), Reach()

    def episodes(self) -> Iterator[EnvEpisode]:
        """Seeds in pairs of a group."""
        for seed in range(self._count):
            colour = ("red", "blue")[seed % 2]
            yield EnvEpisode(f"reach-{seed:02d}", seed, f"Put the cube on the {colour} shape", f"pair-{seed // 2}")

    def reset(self, episode: EnvEpisode) -> Step:
        """The beginning, with its facts."""
        self._episode = episode
        return self._as_step(self._env.reset(seed=episode.seed)[0])

    def step(self, action: np.ndarray) -> Step:
        """One action of the checkpoint, in metres."""
        observed, _, done, late, info = self._env.step(action)
        return self._as_step(observed, done or late, bool(info["is_success"]))

    def close(self) -> None:
        """Nothing is open."""
        self._env.close()

    def _as_step(self, observed: dict[str, Any], done: bool = False, success: bool = False) -> Step:
        observation = Observation(observed["pixels"], observed["agent_pos"], self._episode.instruction)
        facts = {"block": self._env.block, "left": self._env.block < 0, "success": success}
        return Step(observation, done, facts)


class TwoCameras(ReachEnv):
    """A second camera looks at the table from the other end; hand and block lie elsewhere for every `first`."""

    def __init__(self, count: int | str = 12, first: int | str = 0) -> None:
        super().__init__(count)
        self._first = int(first)

    def reset(self, episode: EnvEpisode) -> Step:
        """The beginning, of a seed that is `first` seeds on."""
        self._episode = episode
        return self._as_step(self._env.reset(seed=self._first + episode.seed)[0])

    def _as_step(self, observed: dict[str, Any], done: bool = False, success: bool = False) -> Step:
        step = super()._as_step(observed, done, success)
        turned = np.ascontiguousarray(step.observation.image[::-1, ::-1])
        return replace(step, observation=replace(step.observation, cameras={"wrist": turned}))


class Drifting(ReachEnv):
    """Its frames depend on what was played before."""

    def reset(self, episode: EnvEpisode) -> Step:
        """Seeded once only."""
        self._episode = episode
        self._first = getattr(self, "_first", episode.seed)
        return self._as_step(self._env.reset(seed=None if hasattr(self._env, "block") else self._first)[0])


class Nearing(ReachEnv):
    """Succeeds while the hand is nearer to the block than it was at the beginning."""

    def reset(self, episode: EnvEpisode) -> Step:
        """The beginning, whose distance is kept."""
        self._away = 0.0
        begin = super().reset(episode)
        self._away = abs(self._env.hand[1] - self._env.block)
        return begin

    def _as_step(self, observed: dict[str, Any], done: bool = False, success: bool = False) -> Step:
        del success
        return super()._as_step(observed, done, bool(abs(self._env.hand[1] - self._env.block) < self._away))


class Unjudged(ReachEnv):
    """Says no success."""

    def _as_step(self, observed: dict[str, Any], done: bool = False, success: bool = False) -> Step:
        step = super()._as_step(observed, done, success)
        return Step(step.observation, done, {name: fact for name, fact in step.facts.items() if name != "success"})


class Reusing(ReachEnv):
    """Every picture is the same buffer."""

    def _as_step(self, observed: dict[str, Any], done: bool = False, success: bool = False) -> Step:
        step = super()._as_step(observed, done, success)
        if not hasattr(self, "_buffer"):
            self._buffer = np.empty((SIDE, SIDE, 3), np.uint8)
        self._buffer[:] = step.observation.image
        self._buffer[0, 0] = self._env.steps
        return Step(Observation(self._buffer, step.observation.state, self._episode.instruction), done, step.facts)


class Forgetful(ReachEnv):
    """Says a fact at some steps only."""

    def _as_step(self, observed: dict[str, Any], done: bool = False, success: bool = False) -> Step:
        step = super()._as_step(observed, done, success)
        late_fact = {"late": True} if self._env.steps > 2 else {}
        return Step(step.observation, done, {**step.facts, **late_fact})


class Late(ReachEnv):
    """Knows its facts behind the first step."""

    def reset(self, episode: EnvEpisode) -> Observation:  # type: ignore[override]
        """The beginning alone."""
        return super().reset(episode).observation


class Shrinking(ReachEnv):
    """Leaves numbers out of the state behind the first step."""

    def _as_step(self, observed: dict[str, Any], done: bool = False, success: bool = False) -> Step:
        step = super()._as_step(observed, done, success)
        state = step.observation.state[: None if self._env.steps < 2 else 5]
        return Step(Observation(step.observation.image, state, self._episode.instruction), done, step.facts)


class Broken(ReachEnv):
    """Raises at the third step."""

    def step(self, action: np.ndarray) -> Step:
        """An error of its own."""
        if self._env.steps == 2:
            raise ZeroDivisionError("the simulator exploded")
        return super().step(action)


class Nameless(ReachEnv):
    """Has no revision."""

    revision = ""


class Wide(ReachEnv):
    """Takes eight numbers."""

    action_names = (*ReachEnv.action_names, "torque")
