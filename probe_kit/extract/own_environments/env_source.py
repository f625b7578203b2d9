"""`EnvSource`: which environment of the user's own is played, and which of its episodes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from probe_kit.errors import UsageError
from probe_kit.extract.recordings.lerobot_source import read_episodes
from probe_kit.hooks.contract.options import read_pairs

LEROBOT = "lerobot"
MAX_STEPS = 200
MOST_STEPS = 10_000


@dataclass(frozen=True)
class EnvSource:
    """An environment of the user's own in place of a scene.

    environment: MODULE:CLASS of the contract `OwnEnvironment`, `lerobot:TYPE` for a configuration of lerobot, or
    the name of an entry point of the group `probe_kit.sources`. options: keyword arguments of the class.
    episodes: indices among its episodes; None for all. max_steps: actions after which an episode ends. pixels:
    whether pictures at 32 × 32 are stored for controls.
    Raises UsageError for what no environment can have.
    """

    environment: str
    options: tuple[tuple[str, Any], ...] = ()
    episodes: tuple[int, ...] | None = None
    max_steps: int = MAX_STEPS
    pixels: bool = True

    def __post_init__(self) -> None:
        if isinstance(self.options, Mapping):
            object.__setattr__(self, "options", tuple(self.options.items()))
        if self.episodes is not None:
            object.__setattr__(self, "episodes", tuple(sorted({int(one) for one in self.episodes})))
            if not self.episodes or self.episodes[0] < 0:
                raise UsageError(
                    f"episodes are {list(self.episodes)[:5]}; expected indices from 0 on, at least one"
                )
        if not 1 <= self.max_steps <= MOST_STEPS:
            raise UsageError(f"max_steps is {self.max_steps}; expected 1 to {MOST_STEPS} actions per episode")

    @classmethod
    def from_options(
        cls, environment: str, options: list[str] | None, episodes: str | None, max_steps: int | None, pixels: bool
    ) -> Self:
        """The source that the options of a command name. Raises UsageError."""
        return cls(
            environment,
            tuple(read_pairs(options or []).items()),
            None if episodes is None else read_episodes(episodes),
            MAX_STEPS if max_steps is None else max_steps,
            pixels,
        )

    @property
    def name(self) -> str:
        """What tables call it."""
        return self.environment
