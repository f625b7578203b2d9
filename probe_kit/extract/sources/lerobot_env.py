"""The environments of `--env lerobot:TYPE`, which lerobot configures, with lerobot's own processors.

The simulators are packages of their own; without one, an error names it and nothing is played.
"""

import dataclasses
import json
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from difflib import get_close_matches
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.imports import require
from probe_kit._system.machine import is_out_of_memory
from probe_kit._system.table_cells import is_count
from probe_kit.errors import MissingExtraError, OwnEnvironmentError, ProbeKitError, UsageError
from probe_kit.extract.sources.environment import SUCCESS, EnvEpisode, Step
from probe_kit.extract.sources.step_limits import limit_of
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.families.shared.kinds import IMAGES, STATE

IMAGE = "observation.image"
PER_TASK = 20
"""The episodes per task where no number is given."""


class LeRobotEnvironment:
    """The environments of one `EnvConfig` of lerobot: every task, with a number of seeds each.

    Args:
        kind: The name in lerobot, such as `libero`, `pusht`, `aloha` or `metaworld`.
        per_task: The number of episodes of a task.
        instruction: The words that the model reads where the environment has no text; None for the environment's.
        **options: Fields of the configuration, as text or values.

    Raises:
        UsageError: For an unknown name or field, for one whose code is fetched from the hub, and for a task or
            field that the installed simulator refuses.
        MissingExtraError: Without the simulator.
    """

    def __init__(
        self, kind: str, per_task: int | str = PER_TASK, instruction: str | None = None, **options: Any
    ) -> None:
        self._kind, self._per_task, self._instruction = kind, _count(per_task), instruction
        self._typed = tuple(options)
        self._config = _configuration(kind, {name: _value(value) for name, value in options.items()})
        self._before, self._after = self._config.get_env_processors()
        self._tasks = self._create()
        self._environment: Any = None
        first = next(iter(self._tasks.values()))
        self.action_names = tuple(str(position) for position in range(int(first.action_space.shape[-1])))
        self.revision = f"lerobot {version('lerobot')}, {kind} {self._config.task or ''}".strip() + _simulator(
            kind
        )

    def _create(self) -> dict[str, Any]:
        """Return the only environment of every task, not vectorized."""
        try:
            with _naming_simulator(self._kind):
                suites = self._config.create_envs(n_envs=1, use_async_envs=False)
        except ProbeKitError:
            raise
        except Exception as error:
            if is_out_of_memory(error):
                raise
            raise UsageError(_refused_options(self._kind, self._config, self._typed, error)) from error
        return {
            f"{suite}-{number}": vector.envs[0]
            for suite, tasks in suites.items()
            for number, vector in tasks.items()
        }

    def episodes(self) -> Iterator[EnvEpisode]:
        """Yield every task with the seeds 0, 1, 2 and so on.

        Each is a group of its own, because a seed is another start. Where a task has stored initial states and
        more seeds than these, the seeds of one initial state are a group.
        """
        limits = {task: limit_of(environment) for task, environment in self._tasks.items()}
        differ = len(set(limits.values())) > 1
        for task, environment in self._tasks.items():
            text = self._instruction or _text(environment)
            if not text:
                raise OwnEnvironmentError(
                    f"lerobot:{self._kind} has no instruction for {task}; give one with "
                    "--env-option instruction=TEXT"
                )
            states = _count_initial_states(environment)
            repeat = states is not None and self._per_task > states
            for seed in range(self._per_task):
                group = f"{task}/state-{seed % states:04d}" if repeat and states else None
                yield EnvEpisode(f"{task}/{seed:04d}", seed, text, group, limits[task] if differ else None)

    def reset(self, episode: EnvEpisode) -> Step:
        """Set a task up from the episode's seed; where a task has stored beginnings, seed n chooses the n-th."""
        self._episode = episode
        self._environment = self._tasks[episode.id.rpartition("/")[0]]
        inner = self._environment.unwrapped
        if hasattr(inner, "init_state_id"):
            inner.init_state_id = episode.seed
        with _naming_simulator(self._kind):  # some are imported at the first reset
            observation, _ = self._environment.reset(seed=episode.seed)
        return Step(self._observe(observation))

    def step(self, action: NDArray[np.float32]) -> Step:
        """Execute an action that lerobot's processor of actions has converted."""
        import torch

        passed = self._after({"action": torch.from_numpy(action)[None]})["action"]
        observation, reward, terminated, truncated, info = self._environment.step(
            np.asarray(passed[0], np.float32)
        )
        facts = {"reward": float(reward), SUCCESS: bool(info.get("is_success", False))}
        return Step(self._observe(observation), bool(terminated or truncated), facts)

    def close(self) -> None:
        """Close every task."""
        for environment in self._tasks.values():
            environment.close()

    def _observe(self, observation: Mapping[str, Any]) -> Observation:
        """Return an observation as lerobot's policies get it: its names, order of states and turned pictures."""
        from lerobot.envs.utils import preprocess_observation

        features = self._before(preprocess_observation(_add_batch_axis(observation)))
        pictures = {
            name: _picture(features[name]) for name in features if name == IMAGE or name.startswith(IMAGES)
        }
        if not pictures or STATE not in features:
            raise OwnEnvironmentError(
                f"lerobot:{self._kind} shows {', '.join(sorted(features))}; expected pictures and {STATE}"
            )
        first, *other_cameras = pictures
        self.first_camera = first.removeprefix(IMAGES)
        cameras = {name.removeprefix(IMAGES): pictures[name] for name in other_cameras}
        state = np.asarray(features[STATE][0], np.float32)
        return Observation(pictures[first], state, self._episode.instruction, None, cameras)


@contextmanager
def _naming_simulator(kind: str) -> Iterator[None]:
    """Print to stderr what lerobot prints. Raises MissingExtraError naming a simulator that is not installed."""
    try:
        with redirect_stdout(sys.stderr):
            yield
    except ImportError as error:
        raise MissingExtraError(
            f"lerobot:{kind} needs a simulator that is not installed: {str(error).rstrip('.')}. Install it as "
            f"lerobot's page on {kind} says; where lerobot has an extra for it, that is lerobot[{kind}]"
        ) from error
    except EOFError as error:
        raise UsageError(
            f"lerobot:{kind} asks a question when it is used first, which only a terminal can answer. Run once in "
            f'one: python -c "import {_module_of(error)}"'
        ) from error


def _module_of(error: BaseException) -> str:
    """Return the name of the module that raised an error."""
    frames = list(traceback.walk_tb(error.__traceback__))
    return str(frames[-1][0].f_globals.get("__name__", ""))


MOST_LISTED = 12
"""The most names of tasks that a message lists."""
_INTERNAL = ("features", "features_map", "disable_env_checker", "max_parallel_tasks")
"""The fields of a configuration that no user of `--env` changes."""


def _refused_options(kind: str, config: Any, typed: Sequence[str], error: Exception) -> str:
    """Return the message for a configuration that the installed simulator refuses: what it has in its place."""
    reason = f"{type(error).__name__}: {str(error)[:300].rstrip('.')}"
    names, task = _task_names(kind, config), str(config.task or "")
    unknown = [part.strip() for part in task.split(",") if _bare_task(kind, part) not in names]
    if names and unknown:
        default = "" if "task" in typed else ", lerobot's default"
        bare = _bare_task(kind, unknown[0])
        nearest = get_close_matches(bare, names, len(names), 0)
        more = f" … ({len(names)} in all)" if len(names) > MOST_LISTED else ""
        return (
            f"--env lerobot:{kind}: the installed simulator has no task {unknown[0]!r}{default} ({reason}). "
            f"It has {', '.join(nearest[:MOST_LISTED])}{more}; give one with --env-option task={nearest[0]}"
        )
    fields = ", ".join(
        f"{field.name}={getattr(config, field.name)!r}"
        for field in dataclasses.fields(config)
        if field.name not in _INTERNAL
    )
    return (
        f"--env lerobot:{kind}: the installed simulator refuses lerobot's configuration ({reason}). It is "
        f"{fields}; give another value with --env-option NAME=VALUE, or install the simulator that lerobot names"
    )


def _bare_task(kind: str, task: str) -> str:
    return task.strip().removeprefix(f"{kind}-")


def _task_names(kind: str, config: Any) -> list[str]:
    """Return the tasks and suites that Gymnasium's registry or lerobot's module of an environment lists."""
    import gymnasium

    package = f"{config.package_name}/"
    names = dict.fromkeys(name.removeprefix(package) for name in gymnasium.registry if name.startswith(package))
    module = sys.modules.get(f"lerobot.envs.{kind}")
    for constant, value in vars(module).items() if module is not None else ():
        if "TASK" in constant and isinstance(value, Mapping | list | tuple):
            names |= dict.fromkeys(name for name in value if isinstance(name, str))
    return list(names)


def _count_initial_states(environment: Any) -> int | None:
    """Return the number of stored initial states that a task of LIBERO has; None for other environments."""
    inner = environment.unwrapped
    stored = getattr(inner, "_init_states", None)
    return len(stored) if hasattr(inner, "init_state_id") and stored is not None else None


def _count(per_task: int | str) -> int:
    """Return the number of episodes of a task. Raises UsageError for what is none."""
    if not is_count(str(per_task)) or int(per_task) < 1:
        raise UsageError(f"--env-option per_task={per_task}; expected a number of episodes from 1 on")
    return int(per_task)


def _configuration(kind: str, options: Mapping[str, Any]) -> Any:
    require("lerobot", "lerobot")
    from lerobot.envs.configs import EnvConfig, HubEnvConfig

    kinds = EnvConfig.get_known_choices()
    if kind not in kinds:
        raise UsageError(
            f"--env lerobot:{kind}: lerobot has no such environment; it has {', '.join(sorted(kinds))}"
        )
    configuration = kinds[kind]
    if issubclass(configuration, HubEnvConfig):
        raise UsageError(
            f"--env lerobot:{kind} would run code from the hub; write an environment of your own for it"
        )
    if not hasattr(configuration, "create_envs") or kind == "gym_manipulator":
        raise UsageError(f"--env lerobot:{kind} is no simulation; choose one of {', '.join(sorted(kinds))}")
    try:
        return configuration(**options)
    except (TypeError, ValueError) as error:
        raise UsageError(f"--env lerobot:{kind} cannot be configured so: {error}. Change --env-option") from error


def _value(text: Any) -> Any:
    """Return the number, list or truth value that a text spells, else the text."""
    if not isinstance(text, str):
        return text
    try:
        return json.loads(text)
    except ValueError:
        return text


def _simulator(kind: str) -> str:
    """Return the version of the package that simulates, where it has the usual name."""
    for name in (f"gym-{kind}", kind, f"hf-{kind}"):
        try:
            return f", {name} {version(name)}"
        except PackageNotFoundError:
            continue
    return ""


def _text(environment: Any) -> str | None:
    inner = environment.unwrapped
    task = getattr(inner, "task_description", None) or getattr(inner, "task", None)
    return str(task) if task else None


def _add_batch_axis(observation: Any) -> Any:
    """Return the arrays of an observation with a first axis of one, as lerobot's processors expect."""
    if isinstance(observation, Mapping):
        return {name: _add_batch_axis(value) for name, value in observation.items()}
    return np.asarray(observation)[None]


def _picture(floats: Any) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) uint8 of lerobot's (1, 3, H, W) floats in [0, 1]."""
    values = np.asarray(floats[0], np.float32).transpose(1, 2, 0)
    return np.ascontiguousarray(np.rint(255 * values).astype(np.uint8))
