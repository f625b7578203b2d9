"""Environments as packages register them: `Reach` in Gymnasium's registry, and lerobot's configurations of it."""

import sys
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from reach_env import Reach, ReachEnv

from probe_kit.extract import EnvEpisode, Step
from probe_kit.extract.sources.lerobot_env import LeRobotEnvironment
from probe_kit.hooks import Observation

LIMIT = 300
PACKAGE = "gym_probe_kit_reach"
sys.modules.setdefault(PACKAGE, ModuleType(PACKAGE))  # lerobot imports it where a task is not registered
gym.register(f"{PACKAGE}/Reach-v0", Reach)
gym.register(f"{PACKAGE}/Long-v0", Reach, max_episode_steps=LIMIT)


class Stubborn(Reach):
    """Ignores the seed of `reset`, as Meta-World's own environments do."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Draw the next beginning of a generator that the constructor seeded."""
        del seed
        if not hasattr(self, "steps"):
            super().reset(seed=7)
        return super().reset(seed=None, options=options)


class Fixed(Reach):
    """Starts equally whatever the seed is."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Place hand and block as seed 1 does."""
        del seed
        return super().reset(seed=1, options=options)


gym.register(f"{PACKAGE}/Stubborn-v0", Stubborn, max_episode_steps=LIMIT)
gym.register(f"{PACKAGE}/Fixed-v0", Fixed, max_episode_steps=LIMIT)


@EnvConfig.register_subclass("probe_kit_reach")
@dataclass
class ReachConfig(EnvConfig):
    """A configuration as lerobot's own are, whose processor turns pictures as that of LIBERO does."""

    task: str | None = "Reach-v0"
    episode_length: int = 8
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {"action": PolicyFeature(type=FeatureType.ACTION, shape=(7,))}
    )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """What `gym.make` gets."""
        return {"max_episode_steps": self.episode_length}

    def get_env_processors(self) -> tuple[Any, Any]:
        """Turned pictures and doubled actions."""

        def turned(observed: dict[str, Any]) -> dict[str, Any]:
            return {**observed, "observation.image": observed["observation.image"].flip(dims=(2, 3))}

        def doubled(passed: dict[str, Any]) -> dict[str, Any]:
            return {"action": 2 * passed["action"]}

        return turned, doubled


@EnvConfig.register_subclass("probe_kit_old")
@dataclass
class OldConfig(ReachConfig):
    """Its default task is one that the installed package no longer has, as that of Meta-World is."""

    task: str | None = "probe_kit_old-Reach-v9"

    @property
    def package_name(self) -> str:
        """The package that registers the tasks."""
        return PACKAGE


@EnvConfig.register_subclass("probe_kit_renamed")
@dataclass
class RenamedConfig(OldConfig):
    """Passes an argument that the installed environment does not take."""

    task: str | None = "Reach-v0"
    width: int = 96

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """What `gym.make` gets."""
        return {"visualization_width": self.width}


@EnvConfig.register_subclass("probe_kit_suites")
@dataclass
class SuitesConfig(ReachConfig):
    """Two tasks with limits of their own, as suites of LIBERO have."""

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        """An environment per task."""
        del use_async_envs
        kinds = {"short": 280, "long": 520}
        return {
            suite: {
                0: gym.vector.SyncVectorEnv(
                    [lambda limit=limit: gym.make(f"{PACKAGE}/Long-v0", max_episode_steps=limit)] * n_envs
                )
            }
            for suite, limit in kinds.items()
        }


def lerobot_reach(**options: Any) -> LeRobotEnvironment:
    """Return `lerobot:probe_kit_reach`, in processes that import this module by its name."""
    return LeRobotEnvironment("probe_kit_reach", instruction="reach it", **options)


class Registered(ReachEnv):
    """Holds an environment that `gym.make` made."""

    def __init__(self, name: str = "Long-v0", count: int | str = 12) -> None:
        super().__init__(count)
        self._env = gym.make(f"{PACKAGE}/{name}")  # type: ignore[assignment]

    def _as_step(self, observed: dict[str, Any], done: bool = False, success: bool = False) -> Step:
        return Step(
            Observation(observed["pixels"], observed["agent_pos"], self._episode.instruction),
            done,
            {"success": success},
        )


class MadeLate(Registered):
    """Makes its simulator at the first reset."""

    def __init__(self, count: int | str = 12) -> None:
        ReachEnv.__init__(self, count)
        self._env = None  # type: ignore[assignment]

    def reset(self, episode: EnvEpisode) -> Step:
        """Make the simulator, and start it."""
        self._env = gym.make(f"{PACKAGE}/Long-v0")  # type: ignore[assignment]
        return super().reset(episode)

    def close(self) -> None:
        """Close the simulator, if there is one."""
        if self._env is not None:
            self._env.close()
