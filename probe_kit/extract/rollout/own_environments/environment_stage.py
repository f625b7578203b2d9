"""A stage that plays an environment of the user's own."""

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ProbeKitError
from probe_kit.extract.own_environments.contract import SUCCESS, Step
from probe_kit.extract.own_environments.environment_plan import PlannedEnvEpisode
from probe_kit.extract.own_environments.opening import (
    checked_step,
    fact_values,
    naming_environment,
    open_environment,
    started,
)
from probe_kit.extract.rollout.recorded.recorded_stage import small_picture
from probe_kit.extract.rollout.stage import Answer, Ending, TimedStage
from probe_kit.extract.sources.environment import EnvSource
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs.layout import AT_END, ONCE, FrameChoice
from probe_kit.runs.small_frames import SmallFrames, shrink

SUCCEEDED, FAILED, ENDED = "success", "failure", "ended"
"""Outcomes: whether the fact `success` is true at the last step; the last one where there is no such fact."""


@dataclass(frozen=True)
class PlayedEnvironment:
    """What a stage plays. facts: names, in stored order. calls: inferences whose inputs are stored."""

    source: EnvSource
    facts: tuple[str, ...]
    calls: int


class EnvironmentStage(TimedStage):
    """Plays the episodes of one environment, and keeps what labels and controls are made of."""

    def __init__(self, played: PlayedEnvironment, script: None = None, frames: FrameChoice = "none") -> None:
        del script
        self._played, self._kept_frames = played, frames
        self._environment = open_environment(played.source)

    def begin(self, planned: PlannedEnvEpisode, film: bool) -> Answer:
        """Set an episode up. Errors carry a note naming it."""
        del film
        self._planned, self._steps = planned, 0
        self._inputs: dict[str, list[NDArray[Any]]] = {}
        self._hash, self._succeeded = blake2b(digest_size=16), False
        try:
            step = started(self._environment, planned.episode, self._name)
            self._first = step.observation.image
            return self._see(step)
        except ProbeKitError as error:
            raise self._named(error) from None

    def advance(self, actions: NDArray[np.float32]) -> Answer:
        """Execute actions (n, D) until they or the episode end."""
        try:
            self._keep("action", actions)
            for action in actions:
                with naming_environment(self._name, "step()"):
                    answer = self._environment.step(action.copy())
                self._steps += 1
                step = checked_step(answer, self._planned.episode, f"{self._name}, step() {self._steps}")
                self._succeeded |= _succeeds(step)
                if step.done or self._steps >= self._played.source.max_steps:
                    return self._end(step)
            return self._see(step)
        except ProbeKitError as error:
            raise self._named(error) from None

    def close(self) -> None:
        """Free the environment."""
        with naming_environment(self._name, "close()"):
            self._environment.close()

    @property
    def _name(self) -> str:
        return self._played.source.name

    def _see(self, step: Step) -> Observation:
        seen, where = step.observation, f"{self._name}, step() {self._steps}"
        pictures = [seen.image, *seen.cameras.values()]
        for picture in pictures:
            self._hash.update(f"{picture.shape}".encode() + np.ascontiguousarray(picture).tobytes())
        self._keep("state", seen.state)
        unknown = self._steps == 0 and not step.facts  # nothing is said of the beginning
        facts = (
            [np.nan] * len(self._played.facts) if unknown else fact_values(step.facts, self._played.facts, where)
        )
        if self._played.facts:
            self._keep("columns", np.array(facts, np.float64))
        if self._played.source.pixels:
            self._keep("pixels", np.stack([small_picture(picture) for picture in pictures]))
        return seen

    def _keep(self, name: str, values: NDArray[Any]) -> None:
        kept = self._inputs.setdefault(name, [])
        if len(kept) < self._played.calls:
            kept.append(np.array(values))

    def _end(self, step: Step) -> Ending:
        fact_values(step.facts, self._played.facts, f"{self._name}, step() {self._steps}")
        at_end, has_success = _succeeds(step), SUCCESS in self._played.facts
        outcome = {
            "outcome": (SUCCEEDED if at_end else FAILED) if has_success else ENDED,
            **({ONCE: self._succeeded, AT_END: at_end} if has_success else {}),
            "steps": self._steps,
            "done": bool(step.done),
            "frames_blake2b": self._hash.hexdigest(),
        }
        inputs = {name: np.stack(rows) for name, rows in self._inputs.items()}
        return Ending(outcome, [], self._small_frames(step.observation.image), inputs=inputs)

    def _small_frames(self, last: NDArray[np.uint8]) -> SmallFrames:
        """The first and the last frame, in small."""
        return () if self._kept_frames == "none" else (shrink(self._first), shrink(last))

    def _named(self, error: ProbeKitError) -> ProbeKitError:
        error.add_note(f"in {self._planned.episode_id} ({self._planned.instruction!r})")
        return error


def _succeeds(step: Step) -> bool:
    return bool(step.facts.get(SUCCESS, False))


def cameras_of(seen: Observation, model: Sequence[str]) -> list[str]:
    """Names of the cameras of an observation; the first is the model's main one."""
    return [*model[:1], *seen.cameras]
