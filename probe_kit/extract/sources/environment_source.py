"""Opened environments of the user's own: chosen episodes, and the player that plays them.

Every error of an environment's code becomes an OwnEnvironmentError.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.escaping import UNSAFE, terminal_safe
from probe_kit._system.imports import entry_points
from probe_kit.errors import (
    CheckpointError,
    ObservationError,
    OtherFramesError,
    OwnEnvironmentError,
    ProbeKitError,
    UsageError,
)
from probe_kit.extract.sources.environment import LEROBOT, SUCCESS, EnvEpisode, EnvSource, OwnEnvironment, Step
from probe_kit.extract.sources.player import SIDE, Answer, Ending, InputsPlayer, Opens
from probe_kit.extract.sources.source import (
    FIRST_EPISODES,
    Played,
    Source,
    check_units,
    compare_states,
    exchanged_names,
    predicted_once,
)
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.observation import Observation, checked_picture
from probe_kit.runs.layout import AT_END, ENVIRONMENT, ONCE, TRUTHS
from probe_kit.runs.plan import Row
from probe_kit.runs.small_frames import SmallFrames, shrink

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


ENTRY_POINTS = "probe_kit.environments"
METHODS = ("episodes", "reset", "step", "close")
MOST_EPISODES = 1_000_000
LONGEST = 200
"""The most characters of an episode's id or group."""


@contextmanager
def naming_environment(name: str, doing: str) -> Iterator[None]:
    """Replace errors of an environment's code in the body by OwnEnvironmentError; those of probe_kit stay."""
    try:
        yield
    except ProbeKitError:
        raise
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {str(error)[:500]}"
        raise OwnEnvironmentError(f"{name} failed in {doing}: {reason}. Correct the environment") from error


def factory_of(name: str) -> Callable[..., Any]:
    """Return the class or function that `name` leads to.

    Raises:
        UsageError: If there is no such module, class or entry point.
        OwnEnvironmentError: For an import that fails.
    """
    module, colon, attribute = name.partition(":")
    if module == LEROBOT and colon:
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
    """Open a new environment. Raises OwnEnvironmentError if it breaks its contract, and as `factory_of`."""
    factory = factory_of(source.environment)
    with naming_environment(source.environment, "its constructor"):
        environment: OwnEnvironment = factory(**dict(source.options))
    check_members(environment, source.environment)
    return environment


def check_members(environment: object, name: str) -> None:
    """Raise OwnEnvironmentError unless the environment has revision, names of actions and all methods."""
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
    """Return the chosen episodes with their indices. Raises OwnEnvironmentError for equal ids."""
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
    """Return the beginning of an episode, as `checked_step` returns it. Raises OwnEnvironmentError."""
    with naming_environment(where, "reset()"):
        answer = environment.reset(episode)
    step = checked_step(Step(answer) if isinstance(answer, Observation) else answer, episode, f"{where}, reset()")
    if step.done:
        raise OwnEnvironmentError(f"{where}, reset() says that the episode is over; expected done=False")
    return step


def checked_step(answer: object, episode: EnvEpisode, where: str) -> Step:
    """Return a step with pictures, state and facts as the contract requires them, in copies of its own.

    An environment may write into its arrays afterwards.

    Raises:
        OwnEnvironmentError: For a step that breaks the contract.
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
    """Return the values of facts in the order of their names. Raises OwnEnvironmentError for other names."""
    if sorted(facts) != sorted(names):
        raise OwnEnvironmentError(
            f"{where} has the facts {sorted(facts)}; expected {sorted(names)}, the same at every step"
        )
    return [float(facts[name]) for name in names]


CATEGORY = "all"
"""The category of every row: environments have no categories."""
SUCCEEDED, FAILED, ENDED = "success", "failure", "ended"
"""The outcomes: whether the fact `success` is true at the last step; the last one where there is no such fact."""


class EnvironmentSource(Source[EnvSource]):
    """The names and chosen episodes of an environment, read once.

    Attributes:
        seen: The first observation; None before a model is checked.
        cameras: The cameras by the model's names; empty before.
        columns: The facts; empty before.
        truths: The facts that are truth values; empty before.
        chunk: The number of actions that the policy predicts at a time; 0 before.
    """

    def __init__(
        self, settings: EnvSource, revision: str, actions: Sequence[str], episodes: Sequence[Any]
    ) -> None:
        """Keep what the environment says; `episodes` has pairs of the index in the environment and the episode."""
        self.settings, self.revision, self.actions = settings, revision, tuple(actions)
        self.episodes: list[tuple[int, EnvEpisode]] = list(episodes)
        self.seen: Observation | None = None
        self.cameras: list[str] = []
        self.truths: list[str] = []
        self.chunk = 0

    @classmethod
    def open(cls, settings: EnvSource, selects_only: bool) -> Self:
        """Open the environment once, and list its episodes. Raises as `open_environment` and `listed_episodes`."""
        del selects_only
        environment = open_environment(settings)
        try:
            listed = listed_episodes(environment, settings)
            return cls(settings, environment.revision, [str(name) for name in environment.action_names], listed)
        finally:
            environment.close()

    def rows(self, seed: int) -> tuple[Row, ...]:
        """Return a row per episode."""
        return tuple(
            Row(
                index,
                {
                    "episode_id": episode.id,
                    "item_id": episode.id,
                    "category": CATEGORY,
                    "group_id": episode.group or episode.id,
                    "instruction": episode.instruction,
                    "env_episode": number,
                    "env_seed": episode.seed,
                    "policy_seed": derive_seed(seed, "policy", episode.id),
                },
                episode,
            )
            for index, (number, episode) in enumerate(self.episodes)
        )

    # -- a model -------------------------------------------------------------------------------------

    def watched(self, cameras: Sequence[str]) -> Self:
        """Set up the first chosen episode; no action is executed, so that facts are those of `reset`."""
        environment = open_environment(self.settings)
        try:
            first = started(environment, self.episodes[0][1], self.name)
        finally:
            environment.close()
        self.seen, self.cameras = first.observation, [*cameras[:1], *first.observation.cameras]
        self._note_facts(first)
        return self

    def check(self, policy: "Policy", accept_units: bool) -> "tuple[Self, Policy]":
        """Set up the first chosen episodes, let the policy predict once, and execute one action of the first.

        Raises:
            OwnEnvironmentError: For cameras, states or actions that do not fit.
            UnitsError: For states far outside the checkpoint's statistics.
            CheckpointError: For a policy whose predictions are no actions.
            UsageError: For a policy that averages overlapping chunks.
        """
        if policy.predicts_relative:
            raise CheckpointError(
                f"{policy.card.checkpoint} predicts changes relative to the state (use_relative_actions), and "
                "nothing adds the state. Take a checkpoint that predicts actions"
            )
        if policy.card.ensemble is not None:
            raise UsageError(
                f"{policy.card.family} averages overlapping chunks of the arm's actions; an environment has its "
                "own units. Leave that option out"
            )
        environment, name = open_environment(self.settings), self.name
        try:
            first = started(environment, self.episodes[0][1], name)
            policy = self._with_cameras(policy, first.observation)
            self._check_state(policy, first.observation)
            chunk = self._predicted(policy, first.observation)
            with naming_environment(name, "step()"):
                second = environment.step(np.array(chunk[0]))
            self._note_facts(checked_step(second, self.episodes[0][1], f"{name}, step() 1"))
            later = [episode for _, episode in self.episodes[1:FIRST_EPISODES]]
            later = later if policy.state_numbers is not None else []
            begins = [first, *(started(environment, episode, name) for episode in later)]
            for begin in begins:
                self._check_state(policy, begin.observation)
            states = np.stack([begin.observation.state for begin in begins])
        finally:
            environment.close()
        self.seen, self.chunk = first.observation, len(chunk)
        self.units = compare_states(policy, [states], self._state_names, begins=True)
        check_units(self.units, f"{name}, the state after reset()", policy, accept_units)
        return self, policy

    def _note_facts(self, step: Step) -> None:
        self.columns = tuple(sorted(step.facts))
        self.truths = [name for name in self.columns if isinstance(step.facts[name], bool | np.bool_)]

    def shown_cameras(self, declared: Sequence[str] | None = None) -> tuple[str, ...] | None:
        """Return the first camera, and those that the first observation names; None if they are unknown.

        The first episode is set up for this if no model was checked and `declared` has the cameras of one.
        """
        if not self.cameras and declared is not None:
            self.watched(declared)
        return tuple(self.cameras) or None

    def _with_cameras(self, policy: "Policy", observation: Observation) -> "Policy":
        self.cameras = [*policy.card.cameras[:1], *observation.cameras]
        try:
            return policy.with_cameras(self.cameras)
        except ObservationError as error:
            raise OwnEnvironmentError(
                f"{self.name}: {error}. `Observation.image` is the model's first camera; name the others in "
                "`Observation.cameras` as the model does"
            ) from error

    def _check_state(self, policy: "Policy", observation: Observation) -> None:
        expected = policy.state_numbers
        if expected is not None and observation.state.shape != (expected,):
            raise OwnEnvironmentError(
                f"{self.name} has a state of {observation.state.size} numbers; {policy.card.checkpoint} reads "
                f"{expected}. Take a checkpoint of this environment"
            )

    def _predicted(self, policy: "Policy", observation: Observation) -> NDArray[np.float32]:
        """Return the actions (chunk, D) of one prediction. Raises OwnEnvironmentError if width or order differ."""
        predicted = predicted_once(policy, observation)
        if predicted.shape[1] != len(self.actions):
            raise OwnEnvironmentError(
                f"{self.name} takes {len(self.actions)} numbers as an action ({', '.join(self.actions)}); "
                f"{policy.card.checkpoint} predicts {predicted.shape[1]}. Take a checkpoint of this environment"
            )
        if (reason := exchanged_names(policy, self.actions)) is not None:
            raise OwnEnvironmentError(
                f"{self.name}: {reason}. Let step() take actions in the checkpoint's order, and name them so"
            )
        return predicted

    def example(self, instruction: str) -> Observation:
        """Return the first observation with a blank picture."""
        assert self.seen is not None
        return replace(self.seen, image=np.zeros_like(self.seen.image), instruction=instruction)

    def play(self, played: Played) -> Opens:
        """Open a player, with an environment of its own."""
        return partial(EnvironmentPlayer, self.settings, self.columns, played)

    # -- what a run says of it -----------------------------------------------------------------------

    @property
    def _state_names(self) -> list[str]:
        return [] if self.seen is None else [str(position) for position in range(self.seen.state.size)]

    def identity(self, execute: int) -> dict[str, Any]:
        """Return the environment by its revision, and what it shows; empty before a model is loaded."""
        if self.seen is None:
            return {ENVIRONMENT: {}}
        settings, observation = self.settings, self.seen
        shapes: dict[str, list[int]] = {
            **({"action": [execute, len(self.actions)]} if execute else {}),
            **({"columns": [len(self.columns)]} if self.columns else {}),
            "state": [int(observation.state.size)],
            **({"pixels": [1 + len(observation.cameras), SIDE, SIDE, 3]} if settings.pixels else {}),
        }
        environment = {
            "kind": "env",
            "environment": settings.environment,
            "options": dict(settings.options),
            "revision": self.revision,
            "max_steps": settings.max_steps,
            "cameras": self.cameras,
            "inputs": shapes,
            "columns": list(self.columns),
            "names": {
                "action": list(self.actions),
                "state": self._state_names,
                **({TRUTHS: self.truths} if self.truths else {}),
            },
        }
        return {ENVIRONMENT: environment}

    def check_same(self, settings: Mapping[str, Any]) -> None:
        """Raise OtherFramesError for another revision."""
        if (stored := settings[ENVIRONMENT]["revision"]) != self.revision:
            raise OtherFramesError(
                f"{self.name} has the revision {self.revision!r}; the run was played in {stored!r}. Use that one"
            )

    def selection(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the numbers of the selected episodes."""
        return {"played": {"name": self.name, "episodes": [row.columns["env_episode"] for row in rows]}}

    def targets(self) -> tuple[str, ...]:
        """Return the facts of the environment."""
        return tuple(f"env.{name}" for name in self.columns)

    def describe(self, rows: Sequence[Row]) -> dict[str, str]:
        """Return environment, cameras, actions, facts and episodes."""
        groups = f"{len(rows)} in {len({row.columns['group_id'] for row in rows})} groups"
        if self.seen is None:
            return {"environment": terminal_safe(self.name), "episodes": groups}
        return {
            "environment": terminal_safe(f"{self.name} ({self.revision})"),
            "cameras": terminal_safe(", ".join(self.cameras)),
            "actions": terminal_safe(", ".join(self.actions)),
            "facts": terminal_safe(", ".join(self.columns)) or "none",
            "episodes": f"{groups}, at most {self.settings.max_steps} actions each",
        }


class EnvironmentPlayer(InputsPlayer):
    """A player of the episodes of one environment, which keeps what labels and controls are made of.

    Args:
        settings: The settings of the environment, of which the player opens its own.
        facts: The names of the facts, in stored order.
        played: The frames and inferences to keep.
    """

    def __init__(self, settings: EnvSource, facts: Sequence[str], played: Played) -> None:
        self._settings, self._facts, self._played = settings, tuple(facts), played
        self._environment = open_environment(settings)

    def begin(self, row: Row, film: bool) -> Answer:
        """Set an episode up."""
        del film
        self.row, self._steps, self._succeeded = row, 0, False
        self._clear()
        step = started(self._environment, row.content, self._settings.name)
        self._first = _pictures(step)
        return self._see(step)

    def advance(self, actions: NDArray[np.float32]) -> Answer:
        """Execute actions (n, D) until they or the episode end."""
        self._keep("action", actions, self._played.calls)
        name = self._settings.name
        for action in actions:
            with naming_environment(name, "step()"):
                answer = self._environment.step(action.copy())
            self._steps += 1
            step = checked_step(answer, self.row.content, f"{name}, step() {self._steps}")
            self._succeeded |= _succeeds(step)
            if step.done or self._steps >= self._settings.max_steps:
                return self._end(step)
        return self._see(step)

    def close(self) -> None:
        """Free the environment."""
        with naming_environment(self._settings.name, "close()"):
            self._environment.close()

    def _see(self, step: Step) -> Observation:
        observation, most = step.observation, self._played.calls
        self._keep_pictures(_pictures(step), self._settings.pixels, most)
        self._keep("state", observation.state, most)
        where = f"{self._settings.name}, step() {self._steps}"
        unknown = self._steps == 0 and not step.facts  # nothing is said of the beginning
        facts = [np.nan] * len(self._facts) if unknown else fact_values(step.facts, self._facts, where)
        if self._facts:
            self._keep("columns", np.array(facts, np.float64), most)
        return observation

    def _end(self, step: Step) -> Ending:
        fact_values(step.facts, self._facts, f"{self._settings.name}, step() {self._steps}")
        at_end, has_success = _succeeds(step), SUCCESS in self._facts
        outcome = {
            "outcome": (SUCCEEDED if at_end else FAILED) if has_success else ENDED,
            **({ONCE: self._succeeded, AT_END: at_end} if has_success else {}),
            "steps": self._steps,
            "done": bool(step.done),
        }
        return self._ending(outcome, self._small_frames(_pictures(step)))

    def _small_frames(self, last: list[NDArray[np.uint8]]) -> SmallFrames:
        """Return the first and the last frame of all cameras side by side, in small."""
        return () if self._played.frames == "none" else (shrink(*self._first), shrink(*last))


def _pictures(step: Step) -> list[NDArray[np.uint8]]:
    """Return the pictures of all cameras, the first one in front."""
    return [step.observation.image, *step.observation.cameras.values()]


def _succeeds(step: Step) -> bool:
    return bool(step.facts.get(SUCCESS, False))
