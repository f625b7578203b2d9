"""The controller of an environment of the user's own: a policy acts there in its own units."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CheckpointError, ObservationError, OwnEnvironmentError, UsageError
from probe_kit.extract.own_environments.contract import EnvEpisode
from probe_kit.extract.own_environments.environment_plan import EnvironmentPlan, plan_env_episodes
from probe_kit.extract.own_environments.opening import (
    checked_step,
    listed_episodes,
    naming_environment,
    open_environment,
    started,
)
from probe_kit.extract.recordings.recorded_plan import SIDE
from probe_kit.extract.rollout.controllers import Turn
from probe_kit.extract.rollout.own_environments.environment_stage import cameras_of
from probe_kit.extract.rollout.preflight import FIRST_EPISODES, exchanged_names, unusual_shares
from probe_kit.extract.rollout.recorded.recorded_controller import RecordedController, check_predictions
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.sources.environment import EnvSource
from probe_kit.hooks.checkpoints.containment import copied
from probe_kit.hooks.checkpoints.third_party import while_acting
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs.layout import TRUTHS, StoredStream

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


class EnvironmentController(RecordedController):
    """Executes the head of every predicted chunk, in the checkpoint's own units."""

    def _executed(self, turn: Turn, chunk: NDArray[np.float32]) -> NDArray[np.float32]:
        del turn
        return chunk[: self.execute]


@dataclass(frozen=True)
class OpenedEnvironment:
    """Names and chosen episodes of an environment, read once. begins: what its first chosen episode shows."""

    source: EnvSource
    revision: str
    action_names: tuple[str, ...]
    episodes: list[tuple[int, EnvEpisode]]

    @classmethod
    def of(cls, source: EnvSource) -> "OpenedEnvironment":
        """Raises what `open_environment` and `listed_episodes` raise."""
        environment = open_environment(source)
        try:
            listed = listed_episodes(environment, source)
            return cls(source, environment.revision, tuple(map(str, environment.action_names)), listed)
        finally:
            environment.close()

    @property
    def instructions(self) -> tuple[str, ...]:
        """Every instruction once, in the order of their letters."""
        return tuple(sorted({episode.instruction for _, episode in self.episodes}))


@dataclass(frozen=True)
class FittedEnvironment:
    """An environment and a policy that was found to play it.

    example: what it shows first. facts: names, in stored order. truths: those that are truth values. chunk:
    actions that the policy predicts at a time. unusual: (D,) share of the first states whose number lies outside
    the checkpoint's statistics.
    """

    opened: OpenedEnvironment
    policy: "Policy"
    example: Observation
    facts: tuple[str, ...]
    truths: tuple[str, ...]
    chunk: int
    unusual: NDArray[np.float64]


def fit_environment(opened: OpenedEnvironment, policy: "Policy") -> FittedEnvironment:
    """Set up the first chosen episodes, let the policy predict once, and execute one action of the first.

    Raises OwnEnvironmentError for cameras, states or actions that do not fit, CheckpointError for a policy whose
    predictions are no actions.
    """
    source, (_, episode) = opened.source, opened.episodes[0]
    if policy.predicts_relative:
        raise CheckpointError(
            f"{policy.card.checkpoint} predicts changes relative to the state (use_relative_actions), and nothing "
            "adds the state. Take a checkpoint that predicts actions"
        )
    if policy.card.ensemble is not None:
        raise UsageError(
            f"{policy.card.family} averages overlapping chunks of the arm's actions; an environment has its own "
            "units. Leave that option out"
        )
    environment = open_environment(source)
    try:
        first = started(environment, episode, source.name)
        policy = _given_cameras(policy, first.observation, source.name)
        _check_state(policy, first.observation, source.name)
        with while_acting(policy.card.family, policy.card.checkpoint):
            chunks = policy.predict(copied([first.observation]), [0])
            check_predictions(chunks, 1)
        if chunks.shape[2] != len(opened.action_names):
            raise OwnEnvironmentError(
                f"{source.name} takes {len(opened.action_names)} numbers as an action "
                f"({', '.join(opened.action_names)}); {policy.card.checkpoint} predicts {chunks.shape[2]}. Take a "
                "checkpoint of this environment"
            )
        if (reason := exchanged_names(policy, opened.action_names)) is not None:
            raise OwnEnvironmentError(
                f"{source.name}: {reason}. Let step() take actions in the checkpoint's order, and name them so"
            )
        with naming_environment(source.name, "step()"):
            second = environment.step(np.array(chunks[0, 0]))
        facts = checked_step(second, episode, f"{source.name}, step() 1").facts
        later = [one for _, one in opened.episodes[1:FIRST_EPISODES]] if policy.state_numbers is not None else []
        states = [first, *(started(environment, one, source.name) for one in later)]
        for begin in states:
            _check_state(policy, begin.observation, source.name)
        unusual = unusual_shares(policy, np.stack([begin.observation.state for begin in states]))
    finally:
        environment.close()
    names = tuple(sorted(facts))
    truths = tuple(name for name in names if isinstance(facts[name], bool | np.bool_))
    return FittedEnvironment(opened, policy, first.observation, names, truths, chunks.shape[1], unusual)


def _given_cameras(policy: "Policy", seen: Observation, name: str) -> "Policy":
    try:
        return policy.with_cameras(cameras_of(seen, policy.card.cameras))
    except ObservationError as error:
        raise OwnEnvironmentError(
            f"{name}: {error}. `Observation.image` is the model's first camera; name the others in "
            "`Observation.cameras` as the model does"
        ) from error


def _check_state(policy: "Policy", seen: Observation, name: str) -> None:
    expected = policy.state_numbers
    if expected is not None and seen.state.shape != (expected,):
        raise OwnEnvironmentError(
            f"{name} has a state of {seen.state.size} numbers; {policy.card.checkpoint} reads {expected}. Take a "
            "checkpoint of this environment"
        )


def environment_controller(fitted: FittedEnvironment, settings: ExtractSettings) -> EnvironmentController:
    """The controller of a run in an environment."""
    blank = replace(fitted.example, image=np.zeros_like(fitted.example.image))
    examples = [replace(blank, instruction=text) for text in fitted.opened.instructions]
    execute = settings.task.execute or fitted.policy.card.execute
    if execute > fitted.chunk:
        raise UsageError(
            f"--execute {execute}: {settings.model.family} gives {fitted.chunk} actions per inference; execute 1 "
            f"to {fitted.chunk} of them"
        )
    return EnvironmentController(
        fitted.policy, settings.model.family, examples, execute, settings.with_every_call(execute).capture.calls,
        settings.capture.tokens == "all", settings.task.edits, settings.task.vectors,
        limit=settings.machine.inference_limit,
    )  # fmt: skip


def environment_plan(
    opened: OpenedEnvironment,
    fitted: FittedEnvironment | None,
    streams: Sequence[StoredStream],
    settings: ExtractSettings,
    execute: int,
) -> EnvironmentPlan:
    """The episodes of an environment. fitted: None where no model is loaded. execute: actions per inference."""
    rows = tuple(plan_env_episodes(opened.episodes, settings.seed))
    per_row = sum(
        stream.raw_bytes(settings.capture.tokens == "all", settings.capture.calls, settings.capture.later_views)
        for stream in streams
    )
    identity = {} if fitted is None else _identity(fitted, execute)
    return EnvironmentPlan(rows, tuple(streams), per_row * len(rows), identity, opened.source.name)


def _identity(fitted: FittedEnvironment, execute: int) -> dict[str, Any]:
    """What a run's identity says. execute: actions per inference."""
    opened, seen = fitted.opened, fitted.example
    source, names = opened.source, list(opened.action_names)
    shapes: dict[str, list[int]] = {
        "action": [execute, len(names)],
        **({"columns": [len(fitted.facts)]} if fitted.facts else {}),
        "state": [int(seen.state.size)],
        **({"pixels": [1 + len(seen.cameras), SIDE, SIDE, 3]} if source.pixels else {}),
    }
    return {
        "kind": "env",
        "environment": source.environment,
        "options": dict(source.options),
        "revision": opened.revision,
        "max_steps": source.max_steps,
        "cameras": cameras_of(seen, fitted.policy.card.cameras),
        "inputs": shapes,
        "columns": list(fitted.facts),
        "names": {
            "action": names,
            "state": [str(place) for place in range(seen.state.size)],
            **({TRUTHS: list(fitted.truths)} if fitted.truths else {}),
        },
    }
