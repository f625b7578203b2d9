"""The loop of a run: two groups of players alternate; one simulates while the model infers for the other."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ProbeKitError
from probe_kit.extract.events import EPISODE_ERRORS, traceback_of
from probe_kit.extract.plan import Row
from probe_kit.extract.rollout.controllers import Controller, Inference, Turn, count_lost_words
from probe_kit.extract.rollout.episode_buffers import BufferPool, EpisodeBuffers
from probe_kit.extract.sources.player import AskablePlayer, Ending, Request
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs.layout import LATER
from probe_kit.runs.seconds import Seconds
from probe_kit.runs.small_frames import SmallFrames
from probe_kit.runs.writer import EpisodeRecord


@dataclass(frozen=True)
class Rollout:
    """The result of one episode: its outcome record, its activations, and its frames if requested.

    trajectory: (T + 1, C) float32 frames of the whole episode. instruction_ids: what the policy was delivered
    as its instruction, None if it reads none or cannot say. control_steps: of every inference, how many actions of
    the episode came before it. inputs: what was shown of recordings, see `Ending`.
    """

    planned: Row
    outcome: dict[str, Any]
    buffers: EpisodeBuffers
    frames: list[NDArray[np.uint8]]
    small_frames: SmallFrames = ()
    trajectory: NDArray[np.float32] | None = None
    instruction_ids: Sequence[int] | None = None
    control_steps: Sequence[int] = ()
    seconds: Seconds = field(default_factory=Seconds)
    inputs: Mapping[str, NDArray[Any]] | None = None

    @property
    def record(self) -> EpisodeRecord:
        """The part that the run stores."""
        buffers = self.buffers
        arrays: dict[str, dict[str, NDArray[Any]]] = {
            "pooled": {**buffers.pooled}, "tokens": {**buffers.tokens}, LATER: {**buffers.later},
        }  # fmt: skip
        return EpisodeRecord(
            self.planned, self.outcome, arrays, buffers.roles, self.trajectory, self.instruction_ids,
            control_steps=self.control_steps, seconds=self.seconds, inputs=self.inputs or {},
            lens_margins=buffers.lens_margins,
        )  # fmt: skip


@dataclass(frozen=True)
class Failure:
    """An episode that could not be played to its end. traceback: of the error that ended it."""

    planned: Row
    reason: str
    traceback: str

    @classmethod
    def from_error(cls, planned: Row, error: ProbeKitError) -> "Failure":
        """The failure of `planned` by `error`."""
        return cls(planned, f"{type(error).__name__}: {error}", traceback_of(error))


class EpisodeSlot:
    """One place in a batch: a player and the episode on it, if any.

    planned: the row of that episode. following: the row that its player starts when the episode ends, while the
    model infers for others. ahead: whether the player began the episode in that way. seen: the observation that
    waits for an inference, None while the player simulates. control_steps: actions before each inference so far.
    steps: actions so far. seconds: of inference. flagged: inferences without a valid action, None where the policy
    cannot tell. past: the chunks so far, for policies that average them. columns: of the outcome.
    """

    def __init__(self, player: AskablePlayer) -> None:
        self.player = player
        self.planned: Row | None = None
        self.following: Row | None = None
        self.ahead = False
        self.seen: Observation | None = None
        self.control_steps: list[int] = []
        self.steps = 0
        self.seconds = 0.0
        self.flagged: int | None = None
        self.instruction_ids: Sequence[int] | None = None
        self.lost_words = 0
        self.past: list[NDArray[np.float32]] = []
        self.columns: Mapping[str, Any] = {}

    def start(self, planned: Row, buffers: EpisodeBuffers, begin: Request | None) -> None:
        """Take an episode up; begin: the question that begins it, None if the player does so already."""
        self.planned, self.buffers, self.seen = planned, buffers, None
        self.control_steps, self.steps, self.seconds = [], 0, 0.0
        self.flagged, self.instruction_ids, self.lost_words, self.past = None, None, 0, []
        self.columns = {}
        self.ahead = begin is None
        if begin is not None:
            self.player.ask(begin[0], *begin[1])

    @property
    def calls(self) -> int:
        """Inferences of the episode so far."""
        return len(self.control_steps)

    def count_inference(self, seconds: float) -> None:
        """Note an inference about what is seen. seconds: that it took."""
        assert self.planned is not None
        self.control_steps.append(self.planned.control_step(self.calls, self.steps))
        self.seconds += seconds

    def turn(self) -> Turn:
        """The inference that is due."""
        assert self.planned is not None
        assert self.seen is not None
        return Turn(self.seen, self.planned, self.calls, self.buffers, self.past)

    def go_on(self, inference: Inference, then: Request | None) -> None:
        """Execute the actions of an inference, or end the episode where it has none."""
        self.seen, self.columns = None, inference.columns
        if inference.actions is None:
            self.player.ask("dismiss", then=then)
            return
        self.steps += len(inference.actions)
        if inference.flagged is not None:
            self.flagged = (self.flagged or 0) + inference.flagged
        self.player.ask("advance", inference.actions, then=then)

    @property
    def counts(self) -> dict[str, int]:
        """The counts of the outcome record: flagged steps, where the policy can tell, and lost words."""
        flagged = {} if self.flagged is None else {"inferences": self.calls, "flagged_steps": self.flagged}
        return flagged | ({"lost_words": self.lost_words} if self.lost_words else {})

    def leave(self) -> None:
        """The episode is over."""
        self.planned, self.seen = None, None


class EpisodeLoop:
    """Plays episode after episode on two groups of players.

    next_episode: what to play next, None for nothing. All slots of a group take their turn in one call of the
    policy; a slot whose episode ends begins the next one at once.
    """

    def __init__(
        self, players: Sequence[AskablePlayer], controller: Controller, ring: BufferPool,
        next_episode: Callable[[], Row | None], film: Callable[[Row], bool],
    ) -> None:  # fmt: skip
        slots = [EpisodeSlot(player) for player in players]
        self._groups = [slots[: len(slots) // 2], slots[len(slots) // 2 :]]
        self._controller, self._pool = controller, ring
        self._next_episode, self._film = next_episode, film

    def __iter__(self) -> Iterator[Rollout | Failure]:
        """Rollouts in the order they end."""
        for group in self._groups:
            for slot in group:
                self._begin_next(slot)
        while any(slot.planned for group in self._groups for slot in group):
            for group in self._groups:
                yield from self._settle(group)
                # Returns at once for the players: they simulate while the next turn belongs to the other group.
                yield from self._infer(group)

    def _begin_next(self, slot: EpisodeSlot, *, ended: bool = False) -> None:
        """ended: whether the player came to an end by itself, and so began what follows if it knew of any."""
        planned, begun = slot.following, ended
        if planned is None:
            planned, begun = self._next_episode(), False
        slot.following = None
        if planned is None:
            slot.leave()
        else:
            # `take` waits while all buffers are being written: a model cannot outrun the disk.
            slot.start(planned, self._pool.take(), None if begun else self._beginning(planned))

    def _beginning(self, planned: Row) -> Request:
        return "begin", (planned, self._film(planned))

    def _then(self, slot: EpisodeSlot) -> Request | None:
        """The request that the slot's player is to begin with if its episode ends now."""
        if slot.following is None:
            slot.following = self._next_episode()
        return None if slot.following is None else self._beginning(slot.following)

    def _settle(self, group: list[EpisodeSlot]) -> Iterator[Rollout | Failure]:
        """Collect answers until the group can take its turn together.

        If all its episodes ended at once, and no player has begun the next one, that is done during the other
        group's turn.
        """
        while waiting := [slot for slot in group if slot.planned and not slot.seen]:
            for slot in waiting:
                assert slot.planned is not None
                try:
                    answer = slot.player.answer()
                except EPISODE_ERRORS as error:
                    yield self._give_up(slot, error)
                    continue
                if isinstance(answer, Observation):
                    slot.seen = answer
                else:
                    assert isinstance(answer, Ending)
                    outcome = {**answer.outcome, **slot.columns, **slot.counts}
                    yield Rollout(
                        slot.planned, outcome, slot.buffers, answer.frames, answer.small_frames, answer.trajectory,
                        slot.instruction_ids, slot.control_steps, Seconds(slot.seconds, answer.seconds),
                        answer.inputs,
                    )  # fmt: skip
                    self._begin_next(slot, ended=True)
            if not any(slot.seen or (slot.planned and slot.ahead) for slot in group):
                return

    def _infer(self, group: list[EpisodeSlot]) -> Iterator[Failure]:
        due = [slot for slot in group if slot.seen]
        if not due:
            return
        # An error here is of the batch: which row caused it is unknown, so all rows are given up and played alone.
        try:
            turns = [slot.turn() for slot in due]
            started = perf_counter()
            inferences = self._controller.infer(turns)
            seconds = (perf_counter() - started) / len(turns)  # its share: a call serves all rows at once
            for slot, turn in zip(due, turns, strict=True):
                if turn.call == 0:
                    slot.instruction_ids = self._controller.instruction_ids(turn.observation.instruction)
                    slot.lost_words = count_lost_words(
                        self._controller.instruction_ids, turn.observation.instruction
                    )
        except EPISODE_ERRORS as error:
            for slot in due:
                yield self._give_up(slot, error)
            return
        for slot, inference in zip(due, inferences, strict=True):
            slot.count_inference(seconds)
            slot.go_on(inference, self._then(slot))

    def _give_up(self, slot: EpisodeSlot, error: ProbeKitError) -> Failure:
        assert slot.planned is not None
        failure = Failure.from_error(slot.planned, error)
        self._pool.give_back(slot.buffers)
        self._begin_next(slot)
        return failure
