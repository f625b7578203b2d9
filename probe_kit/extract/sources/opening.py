"""Opening of an environment of the user's own; whatever its code raises becomes an OwnEnvironmentError."""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit._system.escaping import UNSAFE
from probe_kit._system.imports import entry_points
from probe_kit.errors import ObservationError, OwnEnvironmentError, ProbeKitError, UsageError
from probe_kit.extract.sources.environment import LEROBOT, EnvSource
from probe_kit.extract.sources.environment_contract import SUCCESS, EnvEpisode, OwnEnvironment, Step
from probe_kit.hooks.contract.observation import Observation, checked_picture

ENTRY_POINTS = "probe_kit.environments"
METHODS = ("episodes", "reset", "step", "close")
MOST_EPISODES = 1_000_000
LONGEST = 200
"""Characters of an episode's id or group."""


@contextmanager
def naming_environment(name: str, doing: str) -> Iterator[None]:
    """Errors of an environment's code in the body. Raises OwnEnvironmentError, or an error of ours."""
    try:
        yield
    except ProbeKitError:
        raise
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {str(error)[:500]}"
        raise OwnEnvironmentError(f"{name} failed in {doing}: {reason}. Correct the environment") from error


def factory_of(name: str) -> Callable[..., Any]:
    """The class or function that `name` leads to.

    Raises UsageError, and OwnEnvironmentError for an import that fails.
    """
    module, colon, attribute = name.partition(":")
    if module == LEROBOT and colon:
        from functools import partial

        from probe_kit.extract.sources.lerobot_env import LeRobotEnvironment

        return partial(LeRobotEnvironment, attribute)
    if not colon:
        installed = {entry_point.name: entry_point for entry_point in entry_points(group=ENTRY_POINTS)}
        if name not in installed:
            raise UsageError(
                f"--env {name!r}: expected MODULE:CLASS such as kitchen:Kitchen, lerobot:TYPE, or an installed "
                f"entry point ({', '.join(sorted(installed)) or 'there is none'})"
            )
        with naming_environment(name, "its import"):
            loaded: Callable[..., Any] = installed[name].load()
        return loaded
    if (folder := str(Path.cwd())) not in sys.path:
        sys.path.append(folder)  # a command does not have it; behind all others, so that it hides nothing
    try:
        with naming_environment(name, "its import"):
            opened = import_module(module)
    except OwnEnvironmentError as error:
        if isinstance(error.__cause__, ModuleNotFoundError) and error.__cause__.name == module.split(".")[0]:
            raise UsageError(
                f"--env {name}: there is no module {module}; expected {module}.py in this folder, or an "
                "installed module"
            ) from error
        raise
    factory = getattr(opened, attribute, None)
    if not callable(factory):
        raise UsageError(f"--env {name}: {module} has no class {attribute!r}")
    typed_factory: Callable[..., Any] = factory
    return typed_factory


def open_environment(source: EnvSource) -> OwnEnvironment:
    """A new environment. Raises OwnEnvironmentError if it breaks its contract, and as `factory_of`."""
    factory = factory_of(source.environment)
    with naming_environment(source.environment, "its constructor"):
        environment: OwnEnvironment = factory(**dict(source.options))
    check_members(environment, source.environment)
    return environment


def check_members(environment: object, name: str) -> None:
    """Raise OwnEnvironmentError unless revision, names of actions and all methods are there."""
    missing = [method for method in METHODS if not callable(getattr(environment, method, None))]
    if missing:
        raise OwnEnvironmentError(f"{name} has no method {missing[0]!r}; expected {', '.join(METHODS)}")
    revision = getattr(environment, "revision", None)
    if not isinstance(revision, str) or not revision.strip() or UNSAFE.search(revision):
        raise OwnEnvironmentError(
            f"{name} has the revision {revision!r}; expected a text that changes with its numbers, such as "
            "'kitchen 1.2, mujoco 3.3'"
        )
    names = getattr(environment, "action_names", None)
    if isinstance(names, str) or not isinstance(names, Sequence) or not names or len(set(names)) < len(names):
        raise OwnEnvironmentError(
            f"{name} has the action_names {names!r}; expected a name for each number of an action, each once"
        )


def listed_episodes(environment: OwnEnvironment, source: EnvSource) -> list[tuple[int, EnvEpisode]]:
    """The chosen episodes with their indices. Raises OwnEnvironmentError for equal ids."""
    indices = source.episodes
    most = MOST_EPISODES if indices is None else indices[-1] + 1
    with naming_environment(source.name, "episodes()"):
        episodes = list(islice(environment.episodes(), most + (indices is None)))
    if len(episodes) > MOST_EPISODES:
        raise OwnEnvironmentError(
            f"{source.name} has more than {MOST_EPISODES:,} episodes; choose with --episodes"
        )
    for number, episode in enumerate(episodes):
        _check_episode(episode, f"{source.name}, episode {number}")
    ids = [episode.id for episode in episodes]
    if len(set(ids)) < len(ids):
        twice = next(episode_id for episode_id in ids if ids.count(episode_id) > 1)
        raise OwnEnvironmentError(f"{source.name} has two episodes of the id {twice!r}; expected each once")
    if indices is not None and indices[-1] >= len(episodes):
        raise UsageError(
            f"{source.name} has {len(episodes)} episodes, counted from 0; asked for {indices[-1]}. Give episodes "
            f"within 0:{len(episodes)}"
        )
    if not episodes:
        raise OwnEnvironmentError(f"{source.name} has no episode; expected at least one")
    return [(number, episodes[number]) for number in (range(len(episodes)) if indices is None else indices)]


def _check_episode(episode: object, where: str) -> None:
    if not isinstance(episode, EnvEpisode):
        raise OwnEnvironmentError(f"{where} is a {type(episode).__name__}; expected an EnvEpisode")
    texts = {"id": episode.id, "instruction": episode.instruction, "group": episode.group or episode.id}
    for name, text in texts.items():
        if not isinstance(text, str) or not text.strip() or UNSAFE.search(text):
            raise OwnEnvironmentError(f"{where} has the {name} {text!r}; expected plain text")
    if len(episode.id) > LONGEST or len(texts["group"]) > LONGEST:
        raise OwnEnvironmentError(f"{where} has an id or group of more than {LONGEST} characters; shorten it")
    if isinstance(episode.seed, bool) or not isinstance(episode.seed, int) or episode.seed < 0:
        raise OwnEnvironmentError(f"{where} has the seed {episode.seed!r}; expected a whole number from 0 on")


def started(environment: OwnEnvironment, episode: EnvEpisode, where: str) -> Step:
    """The beginning of an episode, as `checked_step` gives it. Raises OwnEnvironmentError."""
    with naming_environment(where, "reset()"):
        answer = environment.reset(episode)
    step = checked_step(Step(answer) if isinstance(answer, Observation) else answer, episode, f"{where}, reset()")
    if step.done:
        raise OwnEnvironmentError(f"{where}, reset() says that the episode is over; expected done=False")
    return step


def checked_step(answer: object, episode: EnvEpisode, where: str) -> Step:
    """A step with pictures, state and facts as the contract has them, in copies of its own.

    An environment may write into its arrays afterwards. Raises OwnEnvironmentError.
    """
    if not isinstance(answer, Step) or not isinstance(answer.observation, Observation):
        kind = type(answer.observation if isinstance(answer, Step) else answer).__name__
        raise OwnEnvironmentError(f"{where} gave a {kind}; expected a Step with an Observation")
    seen_now = answer.observation
    try:
        for picture in (seen_now.image, *seen_now.cameras.values()):
            checked_picture(np.asarray(picture))
    except ObservationError as error:
        raise OwnEnvironmentError(f"{where}: {error}") from None
    state = seen_now.state
    if not isinstance(state, np.ndarray) or state.dtype != np.float32 or state.ndim != 1:
        is_array = isinstance(state, np.ndarray)
        described = f"{state.dtype} {state.shape}" if is_array else type(state).__name__
        raise OwnEnvironmentError(f"{where}: the state is {described}; expected float32 (D,)")
    if not np.isfinite(state).all():
        raise OwnEnvironmentError(f"{where}: the state holds NaN or infinity; expected finite numbers")
    if seen_now.instruction != episode.instruction:
        raise OwnEnvironmentError(
            f"{where}: the observation has the instruction {seen_now.instruction!r}, the episode "
            f"{episode.instruction!r}; expected the same"
        )
    for name, value in answer.facts.items():
        number = isinstance(value, bool | int | float | np.bool_ | np.integer | np.floating)
        if not isinstance(name, str) or not name.strip() or UNSAFE.search(name):
            raise OwnEnvironmentError(f"{where}: a fact has the name {name!r}; expected plain text")
        if not number or not np.isfinite(float(value)):
            raise OwnEnvironmentError(
                f"{where}: the fact {name!r} is {value!r}; expected a finite number or a truth value"
            )
        if name == SUCCESS and value not in (0, 1):
            raise OwnEnvironmentError(
                f"{where}: the fact {SUCCESS!r} is {value!r}; expected a truth value: True, False, 1 or 0. Give "
                "a part or a score another name"
            )
    return _copied(answer)


def _copied(step: Step) -> Step:
    observation = step.observation
    cameras = {name: np.array(picture) for name, picture in observation.cameras.items()}
    lens = None if observation.intrinsics is None else np.array(observation.intrinsics)
    copy = replace(
        observation,
        image=np.array(observation.image),
        state=np.array(observation.state),
        intrinsics=lens,
        cameras=cameras,
    )
    return Step(copy, bool(step.done), dict(step.facts))


def fact_values(facts: Mapping[str, Any], names: Sequence[str], where: str) -> list[float]:
    """The values of facts in the order of their names. Raises OwnEnvironmentError for other names."""
    if sorted(facts) != sorted(names):
        raise OwnEnvironmentError(
            f"{where} has the facts {sorted(facts)}; expected {sorted(names)}, the same at every step"
        )
    return [float(facts[name]) for name in names]
