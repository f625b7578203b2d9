"""The loop of `probe-kit ask`: each episode is set up and rendered once, and nothing moves."""

from collections.abc import Callable, Iterator, Sequence
from time import perf_counter

from probe_kit.errors import ProbeKitError
from probe_kit.extract.plan import PlannedEpisode
from probe_kit.extract.rollout.answer_controller import AnswerController, AskTurn
from probe_kit.extract.rollout.controllers import count_lost_words
from probe_kit.extract.rollout.episode_buffers import BufferPool, EpisodeBuffers
from probe_kit.extract.rollout.episode_loop import Failure, Rollout
from probe_kit.extract.rollout.stage import EPISODE_ERRORS, AskableStage, Seen
from probe_kit.hooks.checkpoints.containment import copied
from probe_kit.hooks.checkpoints.third_party import while_acting
from probe_kit.runs.seconds import Seconds


class _Chair:
    """A stage and the episode that is being set up on it, if any."""

    def __init__(self, stage: AskableStage) -> None:
        self.stage = stage
        self.planned: PlannedEpisode | None = None

    def start(self, planned: PlannedEpisode, buffers: EpisodeBuffers) -> None:
        self.planned, self.buffers = planned, buffers
        self.stage.ask("look", planned)


class Asking:
    """Asks about episode after episode; one group of stages is set up while the model answers on the other.

    next_episode: what to ask about next, None for nothing.
    """

    def __init__(
        self, stages: Sequence[AskableStage], controller: AnswerController, ring: BufferPool,
        next_episode: Callable[[], PlannedEpisode | None],
    ) -> None:  # fmt: skip
        chairs = [_Chair(stage) for stage in stages]
        self._groups = [chairs[: len(chairs) // 2], chairs[len(chairs) // 2 :]]
        self._controller, self._pool, self._next_episode = controller, ring, next_episode

    def __iter__(self) -> Iterator[Rollout | Failure]:
        """Rollouts in the order they end."""
        for group in self._groups:
            for chair in group:
                self._begin_next(chair)
        while any(chair.planned for group in self._groups for chair in group):
            for group in self._groups:
                yield from self._ask(group)

    def _begin_next(self, chair: _Chair) -> None:
        planned = self._next_episode()
        if planned is None:
            chair.planned = None
        else:
            chair.start(planned, self._pool.take())

    def _ask(self, group: Sequence[_Chair]) -> Iterator[Rollout | Failure]:
        """One round: everything that is set up is asked about in one call, and the next episodes begin."""
        due: list[tuple[_Chair, AskTurn, Seen]] = []
        for chair in group:
            if chair.planned is None:
                continue
            try:
                seen = chair.stage.answer()
            except EPISODE_ERRORS as error:
                yield self._give_up(chair, chair.planned, error)
                continue
            assert isinstance(seen, Seen)
            due.append((chair, AskTurn(chair.planned, copied([seen.observation])[0], chair.buffers), seen))
        if not due:
            return
        try:
            controller = self._controller
            with while_acting(controller.identity["model"], controller.model.card.checkpoint, controller.limit):
                started = perf_counter()
                outcomes = controller.ask([turn for _, turn, _ in due])
                seconds = (perf_counter() - started) / len(due)
        except EPISODE_ERRORS as error:
            for chair, turn, _ in due:
                yield self._give_up(chair, turn.planned, error)
            return
        for (chair, turn, seen), outcome in zip(due, outcomes, strict=True):
            lost = count_lost_words(controller.instruction_ids, turn.seen.instruction)
            yield Rollout(
                turn.planned, {**outcome, **seen.facts, **({"lost_words": lost} if lost else {})}, turn.buffers,
                [], seen.small_frames,
                instruction_ids=controller.instruction_ids(turn.seen.instruction),
                control_steps=[0], seconds=Seconds(seconds, seen.seconds),
            )  # fmt: skip
            self._begin_next(chair)

    def _give_up(self, chair: _Chair, planned: PlannedEpisode, error: ProbeKitError) -> Failure:
        self._pool.give_back(chair.buffers)
        self._begin_next(chair)
        return Failure.from_error(planned, error)
