"""The check of an environment of the user's own against what probe_kit relies on, promise by promise."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit._execution.array_connection import ArrayConnection
from probe_kit._execution.process_pool import Child
from probe_kit._system.counting import plural
from probe_kit.errors import MissingExtraError, ProbeKitError, UsageError
from probe_kit.extract.sources.environment import EnvEpisode, EnvironmentSettings, OwnEnvironment, Step
from probe_kit.extract.sources.environment_source import (
    checked_step,
    fact_values,
    frames_of_steps,
    listed_episodes,
    naming_environment,
    open_environment,
    start_episode,
)
from probe_kit.extract.sources.environment_starts import compare_steps
from probe_kit.extract.sources.step_limits import declared_limit
from probe_kit.runs.input_content import content_notes

STEPS = 5
"""The actions per episode that the check executes."""
EPISODES = 2
_SIZE = 0.01
"""The standard deviation of their numbers: small in metres, in radians and in normalized units."""


@dataclass(frozen=True)
class EnvironmentCheck:
    """The result of checking one promise of the contract.

    Attributes:
        problem: The text of what was seen and expected; empty where the promise holds.
        facts: What the environment declares or shows, such as its limit and the sizes of its pictures.
        notes: Sentences about inputs without content, such as a black camera; the promise holds with them.
    """

    name: str
    sentence: str
    problem: str = ""
    facts: str = ""
    notes: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether the promise holds."""
        return not self.problem


class _Trial:
    """An environment under check, its first episodes, and their steps: each exists once its check passed."""

    environment: OwnEnvironment
    episodes: list[EnvEpisode]
    steps: list[list[Step]]

    def __init__(self, source: EnvironmentSettings, picture: Path | None = None) -> None:
        self.source, self.picture = source, picture
        self.notes: tuple[str, ...] = ()

    def __getattr__(self, name: str) -> NoReturn:
        raise _BrokenError(f"there is no {name} to check, see above")

    def open(self) -> str:
        self.environment = open_environment(self.source)
        return f"{self.environment.revision}; actions {', '.join(map(str, self.environment.action_names))}"

    def list_episodes(self) -> str:
        first, second = (listed_episodes(self.environment, self.source) for _ in range(2))
        if first != second:
            raise _BrokenError(
                "episodes() gave another list the second time; expected the same, in the same order"
            )
        self.episodes = [episode for _, episode in first[:EPISODES]]
        groups = {episode.group or episode.id for _, episode in first}
        return f"{plural(len(first), 'episode')} in {plural(len(groups), 'group')}"

    def play(self) -> str:
        """Play the episodes, write their first picture, and say where the environment ends them."""
        self.steps = [self._play(self.environment, episode) for episode in self.episodes]
        names = ["the first camera", *(f"the camera {name!r}" for name in self.steps[0][0].observation.cameras)]
        pairs = zip(self.episodes, self.steps, strict=True)
        frames = [frames_of_steps(episode.id, steps) for episode, steps in pairs]
        self.notes = tuple(content_notes(frames, names))
        start = self.steps[0][0].observation
        if self.picture is not None:
            Image.fromarray(np.hstack(_pad_to_one_height([start.image, *start.cameras.values()]))).save(
                self.picture
            )
        limits = [episode.max_steps for episode in self.episodes if episode.max_steps is not None]
        limit = max(limits, default=None) or declared_limit(self.environment, self.source.name)
        end = "the environment declares no limit" if limit is None else f"an episode ends after {limit} actions"
        return f"{', '.join(f'{name} {_by(shape)}' for name, shape in _shapes(self.steps[0][0]).items())}; {end}"

    def facts_are_constant(self) -> str:
        after = [step for steps in self.steps for step in steps[1:]]
        names = sorted(after[0].facts) if after else []
        for steps in self.steps:
            for number, step in enumerate(steps):
                if number or step.facts:
                    fact_values(step.facts, names, f"{self.source.name}, step() {number}")
        return ", ".join(names) or "there are no facts"

    def repeats(self) -> None:
        """Repeat the first episode, after the other one."""
        again = self._play(self.environment, self.episodes[0])
        _check_equal(self.steps[0], again, "the same episode, played again behind another one")

    def repeats_elsewhere(self) -> None:
        """Repeat the first episode in a new environment, here and in a process that opens its own."""
        first = self.steps[0]
        _check_equal(first, self.play_anew(self.episodes[0]), "the same episode in a second environment")
        child = Child(f"{__name__}:serve")
        try:
            child.connection.send((self.source, self.episodes[0]))
            again = child.connection.recv()
        except (EOFError, ConnectionResetError, BrokenPipeError):
            again = _BrokenError("a process that opens the environment ended; look above for its last words")
        finally:
            child.close()
        if isinstance(again, ProbeKitError):
            raise _BrokenError(f"in another process: {again}")
        _check_equal(first, again, "the same episode in another process")

    def play_anew(self, episode: EnvEpisode) -> list[Step]:
        """Play an episode in a new environment."""
        environment = open_environment(self.source)
        try:
            return self._play(environment, episode)
        finally:
            self._close(environment)

    def close(self) -> None:
        if "environment" in vars(self):
            self._close(self.environment)

    def _close(self, environment: OwnEnvironment) -> None:
        with naming_environment(self.source.name, "close()"):
            environment.close()

    def _play(self, environment: OwnEnvironment, episode: EnvEpisode) -> list[Step]:
        steps = [start_episode(environment, episode, self.source.name)]
        while len(steps) <= STEPS and not steps[-1].done:
            steps.append(self._step(environment, episode, len(steps)))
            self._check_shapes(steps)
        return steps

    def _check_shapes(self, steps: list[Step]) -> None:
        """Raise _BrokenError if the last step has pictures or a state of other shapes than the episode's first."""
        before, now = _shapes(steps[0]), _shapes(steps[-1])
        if changed := [name for name in {**before, **now} if before.get(name) != now.get(name)]:
            name = changed[0]
            raise _BrokenError(
                f"{self.source.name}, step() {len(steps) - 1}: {name} has the shape {now.get(name, 'none')}, in "
                f"reset() {before.get(name, 'none')}; expected the same at every step"
            )

    def _step(self, environment: OwnEnvironment, episode: EnvEpisode, number: int) -> Step:
        draw = np.random.default_rng([episode.seed, number])
        action = (_SIZE * draw.normal(size=len(environment.action_names))).astype(np.float32)
        with naming_environment(self.source.name, "step()"):
            answer = environment.step(action)
        return checked_step(answer, episode, f"{self.source.name}, step() {number}")


class _BrokenError(ProbeKitError):
    """The error of a broken promise."""


def serve(connection: ArrayConnection) -> None:
    """Play one episode in this process, and send its steps or its error."""
    source, episode = connection.recv()
    try:
        connection.send(_Trial(source).play_anew(episode))
    except ProbeKitError as error:
        connection.send(error)


_CHECKS: Sequence[tuple[str, str, Callable[[_Trial], str | None]]] = (
    (
        "it_opens",
        "It opens, with a revision, names of its actions, and the methods episodes, reset, step and close.",
        _Trial.open,
    ),
    ("episodes_are_listed", "Its episodes have different ids, and are the same every time.", _Trial.list_episodes),
    (
        "steps_are_whole",
        "Pictures are uint8 (H, W, 3), the state float32, both of constant shape; facts are finite, and actions "
        "have the promised width.",
        _Trial.play,
    ),
    ("facts_are_constant", "Every step of every episode has facts of the same names.", _Trial.facts_are_constant),
    ("equal_seeds_give_equal_frames", "An episode repeats, frame for frame, behind another one.", _Trial.repeats),
    (
        "a_second_environment_is_equal",
        "A second environment shows the same frames, here and in another process, because each opens its own.",
        _Trial.repeats_elsewhere,
    ),
    ("it_closes", "It closes.", _Trial.close),
)


def check_environment(
    source: EnvironmentSettings | str, picture: Path | str | None = None
) -> Iterator[EnvironmentCheck]:
    """Check that an environment keeps its contract, each rule on the first two episodes; an error is a failure.

    Args:
        source: An `EnvironmentSettings`, or MODULE:CLASS.
        picture: A file for the first pictures of all cameras, side by side, as a model gets them; None for none.

    Raises:
        UsageError: If there is no such class.
        MissingExtraError: If a simulator is not installed; the message names it.
    """
    file = None if picture is None else Path(picture)
    trial = _Trial(EnvironmentSettings(source) if isinstance(source, str) else source, file)
    for name, sentence, check in _CHECKS:
        try:
            facts = check(trial)
        except (UsageError, MissingExtraError):
            raise
        except ProbeKitError as error:
            yield EnvironmentCheck(name, sentence, str(error))
        else:
            notes = trial.notes if check is _Trial.play else ()
            yield EnvironmentCheck(name, sentence, facts=facts or "", notes=notes)


def _shapes(step: Step) -> dict[str, tuple[int, ...]]:
    observation = step.observation
    cameras = {f"the camera {name!r}": picture.shape for name, picture in observation.cameras.items()}
    return {"the picture": observation.image.shape, "the state": observation.state.shape, **cameras}


def _by(shape: Sequence[int]) -> str:
    return " × ".join(map(str, shape))


def _pad_to_one_height(pictures: Sequence[NDArray[np.uint8]]) -> list[NDArray[np.uint8]]:
    """Return pictures (H, W, 3), with black below those that are less high than the highest."""
    height = max(len(picture) for picture in pictures)
    return [np.pad(picture, ((0, height - len(picture)), (0, 0), (0, 0))) for picture in pictures]


def _check_equal(first: list[Step], again: list[Step], which: str) -> None:
    if len(first) != len(again):
        raise _BrokenError(f"{which} ended after {len(again) - 1} actions, before after {len(first) - 1}")
    for number, (was, now) in enumerate(zip(first, again, strict=True)):
        different, equal = compare_steps(was, now)
        if different:
            repeats = f"; equal: {', '.join(equal)}" if equal else ""
            raise _BrokenError(
                f"{which} differs after {number} actions: {', '.join(different)}{repeats}. Take all randomness "
                "from the episode's seed, and set everything up in reset()"
            )
