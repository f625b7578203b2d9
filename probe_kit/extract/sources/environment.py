"""Environments of the user's own: the contract, a class of four methods, and settings of what is played."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, Protocol

import typer
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from probe_kit.extract.parts import read_options
from probe_kit.extract.sources.recording import Cameras, Episodes, Pixels, Rotations
from probe_kit.extract.sources.source import SourceSettings
from probe_kit.hooks.contract.observation import Observation

SUCCESS = "success"
"""The fact that becomes the outcome of an episode."""


@dataclass(frozen=True)
class EnvEpisode:
    """An episode that an environment can play.

    Attributes:
        id: The name of the episode, the same in every selection.
        seed: The seed that decides everything that is random.
        instruction: The words that the model reads.
        group: Episodes of one group share a scene; folds and nulls keep it together. None for a group of its own.
        max_steps: The number of actions after which the benchmark ends this episode; None for the environment's.
    """

    id: str
    seed: int
    instruction: str
    group: str | None = None
    max_steps: int | None = None


@dataclass(frozen=True)
class Step:
    """The state of an environment after an action.

    Attributes:
        observation: The observation that the model gets next.
        done: Whether the episode is over.
        facts: Numbers or truth values by name, which become labels of the next inference; every step of every
            episode has the same names. `success` becomes the outcome.
    """

    observation: Observation
    done: bool = False
    facts: Mapping[str, float | bool] = field(default_factory=lambda: MappingProxyType({}))


class OwnEnvironment(Protocol):
    """An environment that `extract --env MODULE:CLASS` plays; equal seeds give equal episodes.

    It may also have `max_steps`, the number of actions after which its benchmark ends an episode. Without, it is
    that of the simulator that it holds, see `probe_kit.extract.sources.step_limits`.

    Attributes:
        revision: A text that changes with whatever its numbers depend on, such as versions; part of a run's
            identity.
        action_names: The names of the numbers of an action, in the units of the checkpoint that plays it.

    An environment may have `first_camera`, the name of its `Observation.image`. Cameras of the model are then
    found by name, and the order of its pictures has no effect.
    """

    revision: str
    action_names: Sequence[str]

    def episodes(self) -> Iterable[EnvEpisode]:
        """Return all episodes, in the same order every time."""

    def reset(self, episode: EnvEpisode) -> Observation | Step:
        """Set an episode up, and return its beginning; as a `Step` with the facts that are true there."""

    def step(self, action: NDArray) -> Step:  # type: ignore[type-arg]  # as a user writes it
        """Execute one action (D,) float32, and return the state after it."""

    def close(self) -> None:
        """Free what the environment holds."""


LEROBOT = "lerobot"
MAX_STEPS = 200
"""The actions of an episode of an environment that declares no limit."""
MOST_STEPS = 10_000
_option = partial(typer.Option, rich_help_panel="Own environments")

EnvOptions = Annotated[
    list[str] | None,
    _option(
        "--env-option",
        metavar="KEY=VALUE",
        help="Argument of the environment's class, such as task=libero_goal; repeatable.",
    ),
]


class EnvironmentSettings(SourceSettings):
    """An environment of the user's own in place of a scene.

    Attributes:
        environment: MODULE:CLASS of the contract `OwnEnvironment`, `lerobot:TYPE` for a configuration of lerobot,
            or the name of an entry point of the group `probe_kit.environments`.
        options: Keyword arguments of the class.
        episodes: Indices among its episodes; None for all.
        cameras: The environment's picture by camera of the model; `image` is that of `Observation.image` where the
            environment does not name it. Empty for the names of the contract, or those of the checkpoint's files.
        max_steps: The number of actions after which an episode ends; None for the environment's own limit, or 200
            where it declares none.
        rotations: The degrees by camera of the model, counterclockwise; `*` names all cameras.
        accept_nondeterminism: Whether an environment is played in which one seed starts differently each time.
        pixels: Whether pictures at 32 × 32 are stored for controls.
        limit: The largest of the environment's own limits in actions, which is read when it is opened. None
            before, and where it declares none.

    Raises:
        UsageError: For what no environment can have.
    """

    kind: Literal["env"] = "env"
    environment: Annotated[
        str,
        _option(
            "--env",
            metavar="MODULE:CLASS",
            help="Play an environment of your own in place of a suite, or lerobot:TYPE such as lerobot:libero. "
            "`probe-kit check-environment` checks one.",
        ),
    ]
    options: Annotated[dict[str, Any], BeforeValidator(read_options), EnvOptions.__metadata__[0]] = Field(
        default={}
    )
    episodes: Episodes = None
    cameras: Cameras = ()
    max_steps: Annotated[
        Annotated[int, Field(ge=1, le=MOST_STEPS)] | None,
        typer.Option("--max-steps", help="Number of actions per episode."),
    ] = None
    rotations: Rotations = ()
    accept_nondeterminism: Annotated[
        bool,
        _option(
            "--accept-nondeterminism",
            help="Play an environment whose episodes do not repeat with the same seed, such as a real robot.",
        ),
    ] = False
    pixels: Pixels = True
    limit: Annotated[int | None, Field(exclude=True)] = None

    command: ClassVar[str] = "--env MODULE:CLASS"
    opens: ClassVar[str] = "probe_kit.extract.sources.environment_source:EnvironmentSource"
    moves: ClassVar[Mapping[str, str]] = {
        "environment": "The run's environment, if its module was moved or renamed.",
        "options": "Argument of the environment, in addition to those of the run; repeatable.",
    }
    played: ClassVar[str] = "in"
    subject: ClassVar[str] = "environments"
    loads: ClassVar[str] = "environment"
    refuses: ClassVar[tuple[str, ...]] = (
        "protocol", "rotation", "video", "batch=auto", "capture_only", "frames=all",
    )  # fmt: skip
    shows: ClassVar[str] = "--env, in which the model acts in its own units"

    def __init__(self, environment: str, options: Any = None, **choices: Any) -> None:
        super().__init__(**{"environment": environment, "options": options, **choices})

    @property
    def name(self) -> str:
        """The name in tables."""
        return self.environment

    def files(self) -> dict[str, Path]:
        """Return the folder from which the module of the environment was imported, if no package installed it."""
        name = self.environment.partition(":")[0]
        file = getattr(sys.modules.get(name), "__file__", None)
        if file is None or Path(file).is_relative_to(sys.prefix):
            return {}
        path = Path(file).parent if Path(file).name == "__init__.py" else Path(file)
        return {"environment": path.parents[name.count(".")]}

    @classmethod
    def with_files(cls, values: Mapping[str, Any], files: Mapping[str, str]) -> dict[str, Any]:
        """Return the same values: they name a module, and `find_again` makes it importable."""
        del files
        return dict(values)

    @classmethod
    def with_moved(cls, values: Mapping[str, Any], moved: Mapping[str, Any]) -> dict[str, Any]:
        """Return settings as values, with another module; arguments are added to those of the run."""
        return {**values, **moved, "options": {**values["options"], **read_options(moved.get("options", {}))}}

    @classmethod
    def find_again(cls, files: Mapping[str, str]) -> None:
        """Let the module be imported from where a run imported it, after all other folders."""
        if (folder := files.get("environment")) is not None and folder not in sys.path:
            sys.path.append(folder)

    def steps(self) -> int:
        """Count the actions that an episode can have."""
        return self.max_steps or min(self.limit or MAX_STEPS, MOST_STEPS)
