"""Two groups of stages take turns; a stage simulates while the policy infers for the others."""

from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import ActionError
from probe_kit.extract import ExtractSettings, prepare
from probe_kit.extract.rollout.controllers import Inference
from probe_kit.extract.rollout.worker import EpisodeLoop, Rollout
from probe_kit.extract.sources.player import Ending, Failed, LocalPlayer, ProcessPlayer, Row
from probe_kit.extract.sources.scene_source import ScenePlayer
from probe_kit.hooks.contract.observation import Observation
from probe_kit.suite import Suite, build_suite

PICTURE = np.zeros((4, 4, 3), np.uint8)


class Quick:
    """A stage that has done everything by the time it is asked the next thing, and says in `log` what it did.

    length: inferences after which an episode ends. bad: episodes whose actions cannot be executed.
    """

    def __init__(self, log: list[tuple[str, int]], length: int, bad: set[int]) -> None:
        self._log, self._length, self._bad, self._answers = log, length, bad, deque[Any]()

    def ask(self, method: str, *arguments: Any, then: Any = None) -> None:
        self._log.append(("asked", -1))
        answer = self._done(method, *arguments)
        self._answers.append(answer)
        if then is not None and isinstance(answer, Ending):
            self._answers.append(self._done(then[0], *then[1]))

    def _done(self, method: str, *arguments: Any) -> Any:
        if method == "begin":
            self._number, self._turns = arguments[0].index, 0
            self._log.append(("begun", self._number))
            return Observation(PICTURE, np.zeros(7, np.float32), "word", np.eye(3))
        if self._number in self._bad:
            return ActionError("bad")
        self._turns += 1
        if self._turns < self._length and method != "dismiss":
            return Observation(PICTURE, np.zeros(7, np.float32), "word", np.eye(3))
        self._log.append(("ended", self._number))
        return Ending({"number": self._number}, [])

    def answer(self) -> Any:
        answer = self._answers.popleft()
        if isinstance(answer, ActionError):
            raise answer
        return answer

    def close(self) -> None:
        pass


class Thinking:
    """A policy that says in `log` which episodes it is asked about."""

    def __init__(self, log: list[tuple[str, int]], capture_only: bool) -> None:
        self._log, self.capture_only = log, capture_only

    def infer(self, turns: Any) -> list[Inference]:
        self._log.append(("asked for actions", turns[0].row.policy_seed))
        return [Inference(None if self.capture_only else np.zeros((1, 7), np.float32)) for _ in turns]

    def instruction_ids(self, _instruction: str) -> None:
        return None


def played(
    episodes: int, batch: int = 1, length: int = 1, bad: set[int] | None = None, capture_only: bool = False
) -> tuple[list[Rollout | Failed], list[tuple[str, int]]]:
    log: list[tuple[str, int]] = []
    left = iter([Row(number, {"policy_seed": number}) for number in range(episodes)])
    ring: Any = SimpleNamespace(take=lambda: object(), give_back=lambda _buffers: None)
    stages: Any = [Quick(log, length, bad or set()) for _ in range(2 * batch)]
    controller: Any = Thinking(log, capture_only)
    next_episode: Callable[[], Any] = lambda: next(left, None)  # noqa: E731
    return list(EpisodeLoop(stages, controller, ring, next_episode, lambda _planned: False)), log


@pytest.mark.parametrize("capture_only", [False, True])
@pytest.mark.parametrize(("batch", "length"), [(1, 1), (1, 2), (2, 1), (2, 3)])
def test_stages_begin_what_follows_before_their_results_are_collected(
    batch: int, length: int, capture_only: bool
) -> None:
    """So that setting up an episode never falls between two inferences."""
    results, log = played(12, batch, length, capture_only=capture_only)
    assert sorted(result.planned.index for result in results if isinstance(result, Rollout)) == list(range(12))
    begun = [position for position, (what, _) in enumerate(log) if what == "begun"]
    by_themselves = [position for position in begun if log[position - 1][0] == "ended"]
    assert len(begun) == 12
    assert begun[2 * batch :] == by_themselves, "all but the first on every stage"


def test_a_stage_asks_for_nothing_between_the_inferences_of_two_episodes() -> None:
    _, log = played(8)
    thoughts = [position for position, (what, _) in enumerate(log) if what == "asked for actions"]
    asked = [sum(what == "asked" for what, _ in log[one:other]) for one, other in pairwise(thoughts)]
    assert asked == [1] * 7, "its actions, and nothing else"
    assert [log[position][1] for position in thoughts] == list(range(8)), "the groups in turn, none left out"


@pytest.mark.parametrize("batch", [1, 2])
def test_what_was_to_follow_a_failed_episode_is_played_all_the_same(batch: int) -> None:
    results, _ = played(12, batch, bad={0, 3, 4, 11})
    failed = [result.number for result in results if isinstance(result, Failed)]
    kept = [result.planned.index for result in results if isinstance(result, Rollout)]
    assert sorted(failed) == [0, 3, 4, 11]
    assert sorted(failed + kept) == list(range(12)), "every episode once"


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return build_suite(tmp_path_factory.mktemp("suite") / "two", ["color"], 2)


@pytest.fixture(params=[LocalPlayer, ProcessPlayer])
def stage(request: pytest.FixtureRequest) -> Iterator[LocalPlayer | ProcessPlayer]:
    made = request.param(partial(ScenePlayer, SceneSpec(max_steps=2)))
    yield made
    made.close()


def test_a_stage_goes_on_by_itself_where_an_episode_ends_and_only_there(
    stage: LocalPlayer | ProcessPlayer, suite: Suite
) -> None:
    first, second = prepare(ExtractSettings("expert", suite=suite.folder)).plan.episodes[:2]
    begin = ("begin", (second, False))
    alone = ScenePlayer(SceneSpec(max_steps=2))
    expected = alone.begin(second, False)
    alone.close()
    assert isinstance(expected, Observation)

    still = np.zeros((1, 7), np.float32)
    stage.ask("begin", first, False)
    assert isinstance(stage.answer(), Observation)
    stage.ask("advance", still, then=begin)
    assert isinstance(stage.answer(), Observation), "the episode goes on"
    stage.ask("advance", still, then=begin)
    ending, following = stage.answer(), stage.answer()
    assert isinstance(ending, Ending)
    assert isinstance(following, Observation)
    np.testing.assert_array_equal(following.image, expected.image)
    assert following.instruction == expected.instruction
