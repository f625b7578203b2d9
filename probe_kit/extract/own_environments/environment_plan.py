"""The plan of a run in an environment of the user's own: a row per episode."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

from probe_kit.extract.own_environments.contract import EnvEpisode
from probe_kit.extract.plan import RowPlan
from probe_kit.hashing import derive_seed
from probe_kit.runs.layout import ENVIRONMENT

CATEGORY = "all"
"""Of every row: environments have no categories."""


@dataclass(frozen=True)
class PlannedEnvEpisode:
    """One row: an episode of the environment. number: its index there."""

    index: int
    number: int
    episode: EnvEpisode
    policy_seed: int

    @property
    def episode_id(self) -> str:
        """As the environment calls it."""
        return self.episode.id

    @property
    def category(self) -> str:
        """The same for all."""
        return CATEGORY

    @property
    def instruction(self) -> str:
        """What the model reads."""
        return self.episode.instruction

    def numbered(self, index: int) -> Self:
        """The same episode under another number."""
        return replace(self, index=index)

    def control_step(self, call: int, executed: int) -> int:
        """As many actions as were executed before."""
        del call
        return executed

    def noise_of(self, call: int) -> int:
        """The inference itself."""
        return call

    def to_json(self) -> dict[str, Any]:
        """The episode as flat columns."""
        return {
            "episode": self.index,
            "episode_id": self.episode_id,
            "item_id": self.episode_id,
            "category": self.category,
            "group_id": self.episode.group or self.episode_id,
            "instruction": self.instruction,
            "env_episode": self.number,
            "env_seed": self.episode.seed,
            "policy_seed": self.policy_seed,
        }


@dataclass(frozen=True)
class EnvironmentPlan(RowPlan):
    """All episodes of a run. environment: what its identity says of it. name: what tables call it."""

    episodes: tuple[PlannedEnvEpisode, ...]
    environment: Mapping[str, Any]
    name: str

    @property
    def identity(self) -> dict[str, Any]:
        """The environment by its revision, and what it shows."""
        return {ENVIRONMENT: dict(self.environment)}

    @property
    def name_parts(self) -> list[Any]:
        """Nothing beside the identity: a command with more episodes finds its run."""
        return []

    @property
    def selection(self) -> dict[str, Any]:
        """Which episodes were chosen."""
        return {"played": {"name": self.name, "episodes": [one.number for one in self.episodes]}}

    def to_json(self) -> dict[str, Any]:
        """As stored in `plan/`."""
        return {"episodes": [one.to_json() for one in self.episodes], "suite_parent": None}


def plan_env_episodes(listed: list[tuple[int, EnvEpisode]], seed: int) -> Iterator[PlannedEnvEpisode]:
    """The rows of some episodes, in order; the seed of one depends on no other."""
    for index, (number, episode) in enumerate(listed):
        yield PlannedEnvEpisode(index, number, episode, derive_seed(seed, "policy", episode.id))
