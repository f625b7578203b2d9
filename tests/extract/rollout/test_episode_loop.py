"""Two groups of stages take turns; a stage simulates while the policy infers for the others."""

from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from probe_kit.env import SceneSpec
from probe_kit.errors import ActionError
from probe_kit.extract import ExtractSettings, prepare
from probe_kit.extract.rollout import capturing as staging
from probe_kit.extract.rollout.capturing import Capturer, EpisodeBuffers, copy_aside, stored_streams
from probe_kit.extract.rollout.controllers import Inference
from probe_kit.extract.rollout.worker import Ended, EpisodeLoop
from probe_kit.extract.sources.player import Ending, Failed, LocalPlayer, ProcessPlayer
from probe_kit.extract.sources.scene_source import ScenePlayer
from probe_kit.hooks import Roles
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import _matrix
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.runs.layout import StoredStream
from probe_kit.runs.plan import Row
from probe_kit.suite import Suite

PICTURE = np.zeros((4, 4, 3), np.uint8)


class Quick:
    """A stage that has done everything by the time it is asked the next thing, and says in `log` what it did.

    length: inferences after which an episode ends. bad: episodes whose actions cannot be executed.
    """

    def __init__(self, log: list[tuple[str, int]], length: int, bad: set[int]) -> None:
        self._log, self._length, self._bad, self._answers = log, length, bad, deque[Any]()

    def ask(self, method: str, *arguments: Any, then: Any = None) -> None:
        self._log.append(("asked", -1))
        answer = self._call(method, *arguments)
        self._answers.append(answer)
        if then is not None and isinstance(answer, Ending):
            self._answers.append(self._call(then[0], *then[1]))

    def _call(self, method: str, *arguments: Any) -> Any:
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

    def __init__(self, log: list[tuple[str, int]], capture_only: bool, room: int = 99) -> None:
        self._log, self.capture_only, self._room = log, capture_only, room

    def infer(self, turns: Any) -> list[Inference]:
        if len(turns) > self._room:
            raise MemoryError
        self._log.append(("asked for actions", turns[0].row.policy_seed))
        return [Inference(None if self.capture_only else np.zeros((1, 7), np.float32)) for _ in turns]

    def instruction_ids(self, _instruction: str) -> None:
        return None


def played(
    episodes: int,
    batch: int = 1,
    length: int = 1,
    bad: set[int] | None = None,
    capture_only: bool = False,
    room: int = 99,
) -> tuple[list[Ended | Failed], list[tuple[str, int]]]:
    log: list[tuple[str, int]] = []
    remaining = iter([Row(number, {"policy_seed": number}) for number in range(episodes)])
    free: Any = SimpleNamespace(get=lambda: SimpleNamespace(clear=lambda: None), put=lambda _buffers: None)
    stages: Any = [Quick(log, length, bad or set()) for _ in range(2 * batch)]
    controller: Any = Thinking(log, capture_only, room)
    next_episode: Callable[[], Any] = lambda: next(remaining, None)  # noqa: E731
    return list(EpisodeLoop(stages, controller, free, next_episode, lambda _planned: False)), log


@pytest.mark.parametrize("capture_only", [False, True])
@pytest.mark.parametrize(("batch", "length"), [(1, 1), (1, 2), (2, 1), (2, 3)])
def test_stages_begin_what_follows_before_their_results_are_collected(
    batch: int, length: int, capture_only: bool
) -> None:
    """So that setting up an episode never falls between two inferences."""
    results, log = played(12, batch, length, capture_only=capture_only)
    assert sorted(result[0].planned.index for result in results if isinstance(result, tuple)) == list(range(12))
    begun = [position for position, (what, _) in enumerate(log) if what == "begun"]
    by_themselves = [position for position in begun if log[position - 1][0] == "ended"]
    assert len(begun) == 12
    assert begun[2 * batch :] == by_themselves, "all but the first on every stage"


def test_a_stage_asks_for_nothing_between_the_inferences_of_two_episodes() -> None:
    _, log = played(8)
    thoughts = [position for position, (what, _) in enumerate(log) if what == "asked for actions"]
    requests = [sum(what == "asked" for what, _ in log[start:other]) for start, other in pairwise(thoughts)]
    assert requests == [1] * 7, "its actions, and nothing else"
    assert [log[position][1] for position in thoughts] == list(range(8)), "the groups in turn, none left out"


@pytest.mark.parametrize("batch", [1, 2])
def test_episodes_after_a_failed_one_are_played(batch: int) -> None:
    results, _ = played(12, batch, bad={0, 3, 4, 11})
    failed = [result.number for result in results if isinstance(result, Failed)]
    completed = [result[0].planned.index for result in results if isinstance(result, tuple)]
    assert sorted(failed) == [0, 3, 4, 11]
    assert sorted(failed + completed) == list(range(12)), "every episode once"


def test_a_batch_that_exceeds_the_memory_gives_its_episodes_up_and_a_single_one_ends_the_run() -> None:
    """The episodes of a batch are played alone afterwards; where one alone is too large, every other is."""
    results, _ = played(4, batch=2, room=1)
    assert sorted(result.number for result in results if isinstance(result, Failed)) == [0, 1, 2, 3]
    with pytest.raises(MemoryError):
        played(4, batch=1, room=0)


@pytest.fixture(params=[LocalPlayer, ProcessPlayer])
def stage(request: pytest.FixtureRequest) -> Iterator[LocalPlayer | ProcessPlayer]:
    staged = request.param(partial(ScenePlayer, SceneSpec(max_steps=2)))
    yield staged
    staged.close()


@pytest.mark.slow
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


STREAM = StoredStream("backbone", 2, 4, None, 5, ("mean", "last"), quantities=("residual",))
ROLES = {"backbone": Roles.from_labels(["language"] * 5)}
WAITING = {
    "_local_scalar_dense",
    "nonzero",
    "masked_select",
    "is_nonzero",
    "equal",
    "unique",
    "_unique2",
    "lift_fresh",
}
"""Operations that bring a value, or a shape that depends on values, to the host: it waits for the device there."""


class Called(TorchDispatchMode):
    """The names of all operations, in order, and what they moved to another device."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, function, types, arguments=(), keywords=None):  # type: ignore[no-untyped-def]
        self.names.append(function.overloadpacket.__name__)
        return function(*arguments, **(keywords or {}))

    def waiting(self) -> list[str]:
        return [name for name in self.names if name in WAITING]


@pytest.mark.slow
@pytest.mark.parametrize("with_tokens", [False, True])
def test_capture_adds_nothing_to_an_inference_that_waits_for_the_device(
    pi0_tiny: Pi0, observation: Observation, with_tokens: bool
) -> None:
    """The same code runs on a GPU; what waits there is known by its name here."""
    observations, inferences, misses = [observation, observation], list[Called](), list[int]()
    roles = pi0_tiny.roles(observations)
    streams = stored_streams(pi0_tiny, roles)
    capturer = Capturer(pi0_tiny, streams, with_tokens, "actions")
    buffers = {row: EpisodeBuffers(streams, 1, with_tokens, pinned=False) for row in range(2)}

    def infer() -> np.ndarray:
        before = _matrix.cache_info().misses
        with Called() as called:
            actions = pi0_tiny.act(observations, [0, 1])
        inferences.append(called)
        misses.append(_matrix.cache_info().misses - before)
        return actions

    capturer.run(infer, lambda actions: actions, roles, buffers)
    captured, plain = inferences
    assert len(captured.names) > len(plain.names)
    assert captured.waiting() == plain.waiting()
    assert misses == [0, 0], "what pooling needs is on the device before the model runs"


def test_one_question_to_the_device_tells_whether_all_sites_are_finite(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    from probe_kit.hooks import capture

    questions = []
    for sites in (pi0_tiny.sites()[:1], pi0_tiny.sites()):
        with Called() as called, capture(pi0_tiny, sites):
            pi0_tiny.act([observation], [0])
        questions.append(called.waiting().count("_local_scalar_dense"))
    assert questions[0] == questions[1]


def test_tokens_arrive_in_whole_rows_with_zeros_behind_them(monkeypatch: pytest.MonkeyPatch) -> None:
    buffers = EpisodeBuffers([STREAM], 1, True, pinned=False)
    buffers.tokens["backbone"].fill(7)  # as a row of a longer episode would leave it
    contiguous: list[bool] = []

    def copied(source: torch.Tensor, target: torch.Tensor) -> None:
        contiguous.append(target.is_contiguous() and source.is_contiguous())
        copy_aside(source, target)

    monkeypatch.setattr(staging, "copy_aside", copied)
    buffers.keep_roles(ROLES)
    bits = torch.arange(2 * 5 * 4, dtype=torch.int16).reshape(2, 5, 4)
    buffers.keep_tokens("backbone", bits)
    buffers.keep_pooled("backbone", torch.ones(2, 2, 4))
    stored = buffers.tokens["backbone"][0]
    assert stored.shape == (2, STREAM.stored_tokens, 4)
    np.testing.assert_array_equal(stored[:, :5], bits.numpy().view(np.uint16))
    assert not stored[:, 5:].any()
    assert contiguous == [True, True]
    buffers.wait()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU on this machine")
def test_copies_from_a_gpu_arrive_beside_its_next_work() -> None:
    streams = [StoredStream("backbone", 4, 2048, None, 816, ("mean",), quantities=("residual",))]
    buffers = EpisodeBuffers(streams, 1, True, pinned=True)
    bits = torch.randint(-(2**15), 2**15, (4, 816, 2048), dtype=torch.int16, device="cuda")
    expected = bits.cpu().numpy()
    buffers.keep_roles({"backbone": Roles.from_labels(["language"] * 816)})
    buffers.keep_tokens("backbone", bits)
    del bits
    scratch = [torch.full((4, 896, 2048), n, dtype=torch.int16, device="cuda") for n in range(8)]
    buffers.wait()
    np.testing.assert_array_equal(buffers.tokens["backbone"][0][:, :816].view(np.int16), expected)
    assert len(scratch) == 8
