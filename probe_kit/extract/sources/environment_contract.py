"""The contract of an environment of the user's own: a class of four methods."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Protocol

from numpy.typing import NDArray

from probe_kit.hooks.contract.observation import Observation

SUCCESS = "success"
"""The fact that becomes the outcome of an episode."""


@dataclass(frozen=True)
class EnvEpisode:
    """One episode that an environment can play.

    id: the same in every selection. seed: decides everything that is random. instruction: what the model reads.
    group: episodes of one group share a scene; folds and nulls keep it together. None for a group of its own.
    """

    id: str
    seed: int
    instruction: str
    group: str | None = None


@dataclass(frozen=True)
class Step:
    """The state of an environment after an action.

    done: whether the episode is over. facts: numbers or truth values by name, which become labels of the next
    inference; every step of every episode has the same names. `success` becomes the outcome.
    """

    observation: Observation
    done: bool = False
    facts: Mapping[str, float | bool] = field(default_factory=lambda: MappingProxyType({}))


class OwnEnvironment(Protocol):
    """An environment that `extract --env MODULE:CLASS` plays; equal seeds give equal episodes.

    revision: what its numbers depend on, such as versions; part of a run's identity. action_names: of the numbers
    of an action, in the units of the checkpoint that plays it.
    """

    revision: str
    action_names: Sequence[str]

    def episodes(self) -> Iterable[EnvEpisode]:
        """All episodes, in the same order every time."""

    def reset(self, episode: EnvEpisode) -> Observation | Step:
        """Set an episode up, and show its beginning; as a `Step` with the facts that are true there."""

    def step(self, action: NDArray) -> Step:  # type: ignore[type-arg]  # as a user writes it
        """Execute one action (D,) float32."""

    def close(self) -> None:
        """Free what it holds."""
