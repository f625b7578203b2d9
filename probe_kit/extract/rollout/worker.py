"""A worker plays its episodes and commits them. Players and model take turns, and one thread writes."""

import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from time import perf_counter
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit._system.machine import is_out_of_memory
from probe_kit.env import save_gif
from probe_kit.extract.config_files import origin_of_process
from probe_kit.extract.rollout.capturing import EpisodeBuffers
from probe_kit.extract.rollout.controllers import Controller, Inference, Turn, count_lost_words
from probe_kit.extract.settings import Settings
from probe_kit.extract.sources.player import (
    EPISODE_ERRORS,
    AskablePlayer,
    Done,
    Ending,
    Event,
    Failed,
    LocalPlayer,
    ProcessPlayer,
    Request,
    traceback_of,
)
from probe_kit.extract.sources.source import Played, Source
from probe_kit.extract.states import Fitted
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs.commits import Seconds
from probe_kit.runs.layout import VIDEOS, FrameChoice
from probe_kit.runs.plan import Row
from probe_kit.runs.provenance import INPUT_CONTENT
from probe_kit.runs.run_source import ORIGIN
from probe_kit.runs.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.runs.writer import RunWriter


@dataclass
class Playing:
    """An episode on its player.

    Attributes:
        planned: The row of the plan.
        buffers: Everything captured in it.
        ahead: Whether the player began it by itself, when the one before it ended.
        observation: The observation that waits for an inference, None while the player simulates.
        control_steps: The number of actions before each inference so far.
        steps: The number of actions so far.
        seconds: The seconds of inference so far.
        flagged: The number of inferences without a valid action, None where the policy cannot tell.
        instruction_ids: Ids of the instruction as the network gets it; None if they are unknown.
        lost_words: Words at the end of the instruction that do not reach the network.
        past: The chunks so far, for policies that average them.
        columns: Columns of the outcome.
    """

    planned: Row
    buffers: EpisodeBuffers
    ahead: bool
    observation: Observation | None = None
    control_steps: list[int] = field(default_factory=list)
    steps: int = 0
    seconds: float = 0.0
    flagged: int | None = None
    instruction_ids: Sequence[int] | None = None
    lost_words: int = 0
    past: list[NDArray[np.float32]] = field(default_factory=list)
    columns: Mapping[str, Any] = field(default_factory=dict)

    def turn(self) -> Turn:
        """Return the inference that is due."""
        assert self.observation is not None
        return Turn(self.observation, self.planned, len(self.control_steps), self.buffers, self.past)

    def outcome(self, ending: Ending) -> dict[str, Any]:
        """Return the outcome, with the counts of flagged steps, where the policy can tell, and of lost words."""
        counts = {} if self.flagged is None else {
            "inferences": len(self.control_steps), "flagged_steps": self.flagged,
        }  # fmt: skip
        counts |= {"lost_words": self.lost_words} if self.lost_words else {}
        return {**ending.outcome, **self.columns, **counts}


Ended = tuple[Playing, Ending]
"""An episode that was played to its end, and how it ended."""


class EpisodeSlot:
    """A place in a batch: a player and the episode on it, if any.

    Attributes:
        following: The row that its player starts when the episode ends, while the model infers for others.
    """

    def __init__(self, player: AskablePlayer) -> None:
        self.player = player
        self.playing: Playing | None = None
        self.following: Row | None = None


class EpisodeLoop:
    """A loop that plays episode after episode on two groups of players.

    All slots of a group take their turn in one call of the policy; a slot whose episode ends begins the next one
    at once.

    Args:
        players: The players of both groups.
        controller: The controller that infers.
        free: Empty buffers.
        next_episode: A function that returns the next row to play, None for nothing.
        film: A function that says whether a row is filmed.
    """

    def __init__(
        self, players: Sequence[AskablePlayer], controller: Controller, free: "SimpleQueue[EpisodeBuffers]",
        next_episode: Callable[[], Row | None], film: Callable[[Row], bool],
    ) -> None:  # fmt: skip
        slots = [EpisodeSlot(player) for player in players]
        self._groups = [slots[: len(slots) // 2], slots[len(slots) // 2 :]]
        self._controller, self._free = controller, free
        self._next_episode, self._film = next_episode, film

    def __iter__(self) -> Iterator[Ended | Failed]:
        """Yield episodes in the order in which they end."""
        for group in self._groups:
            for slot in group:
                self._begin_next(slot)
        while any(slot.playing for group in self._groups for slot in group):
            for group in self._groups:
                yield from self._settle(group)
                # Returns at once for the players: they simulate while the next turn belongs to the other group.
                yield from self._infer(group)

    def _begin_next(self, slot: EpisodeSlot, *, ended: bool = False) -> None:
        """Begin the next episode, if any.

        With `ended`, the player came to an end by itself, and so began the following row if it knew of one.
        """
        begun = ended and slot.following is not None
        planned, slot.following, slot.playing = slot.following or self._next_episode(), None, None
        if planned is not None:
            # This waits while all buffers are being written: a model cannot outrun the disk.
            slot.playing = Playing(planned, self._free.get(), begun)
            if not begun:
                slot.player.ask("begin", planned, self._film(planned))

    def _go_on(self, slot: EpisodeSlot, playing: Playing, inference: Inference) -> None:
        """Execute the actions of an inference, or end the episode where it has none."""
        if slot.following is None:
            slot.following = self._next_episode()
        # The player is to begin with it if its episode ends now.
        row = slot.following
        then: Request | None = None if row is None else ("begin", (row, self._film(row)))
        playing.observation, playing.columns = None, inference.columns
        if inference.actions is None:
            slot.player.ask("dismiss", then=then)
            return
        playing.steps += len(inference.actions)
        if inference.flagged is not None:
            playing.flagged = (playing.flagged or 0) + inference.flagged
        slot.player.ask("advance", inference.actions, then=then)

    def _settle(self, group: list[EpisodeSlot]) -> Iterator[Ended | Failed]:
        """Collect answers until the group can take its turn together.

        If all its episodes ended at once, and no player has begun the next one, that is done during the other
        group's turn.
        """
        while waiting := [(slot, slot.playing) for slot in group if slot.playing and not slot.playing.observation]:
            for slot, playing in waiting:
                try:
                    answer = slot.player.answer()
                except EPISODE_ERRORS as error:
                    yield self._give_up(slot, playing, error)
                    continue
                if isinstance(answer, Observation):
                    playing.observation = answer
                else:
                    assert isinstance(answer, Ending)
                    yield playing, answer
                    self._begin_next(slot, ended=True)
            if not any(slot.playing and (slot.playing.observation or slot.playing.ahead) for slot in group):
                return

    def _infer(self, group: list[EpisodeSlot]) -> Iterator[Failed]:
        due = [(slot, slot.playing) for slot in group if slot.playing and slot.playing.observation]
        if not due:
            return
        # An error here is of the batch: which row caused it is unknown, so all rows are given up and played alone.
        # So are those of a batch that exceeds the memory; where one row alone does, so would every other.
        try:
            turns = [playing.turn() for _, playing in due]
            started = perf_counter()
            inferences = self._controller.infer(turns)
            seconds = (perf_counter() - started) / len(turns)  # its share: a call serves all rows at once
            for (_, playing), turn in zip(due, turns, strict=True):
                if turn.call == 0:
                    instruction = turn.observation.instruction
                    playing.instruction_ids = self._controller.instruction_ids(instruction)
                    playing.lost_words = count_lost_words(self._controller.instruction_ids, instruction)
        except Exception as error:
            if not isinstance(error, EPISODE_ERRORS) and not (is_out_of_memory(error) and len(due) > 1):
                raise
            for slot, playing in due:
                yield self._give_up(slot, playing, error)
            return
        for (slot, playing), turn, inference in zip(due, turns, inferences, strict=True):
            playing.control_steps.append(playing.planned.control_step(turn.call, playing.steps))
            playing.seconds += seconds
            self._go_on(slot, playing, inference)

    def _give_up(self, slot: EpisodeSlot, playing: Playing, error: Exception) -> Failed:
        playing.buffers.clear()
        self._free.put(playing.buffers)
        self._begin_next(slot)
        return Failed(playing.planned.index, f"{type(error).__name__}: {error}", traceback_of(error))


# Buffers beyond one per player: one is being written while another waits.
SPARE_BUFFERS = 2
# With fewer episodes than this, starting processes takes longer than they save.
WORTH_PROCESSES = 8
# Width and height of a GIF, for people alone: a quarter of the pixels of the default camera.
_FILM_SIZE = (320, 240)


class Worker:
    """A worker that plays and commits episodes; a context manager, as it holds simulators and a writing thread.

    Episodes are written by one thread while the next ones are played. An error in it is raised with the next
    episode; on leaving, whatever was handed to it is written first.

    Args:
        writer: The writer of the run.
        fitted: The settings of the run.
        controller: The controller that infers.
        observations: The number of observations per call of the model.
        source: The source that is played.
        episodes: The most episodes that it will play; for few of them no processes are started.
    """

    def __init__(
        self,
        writer: RunWriter,
        fitted: Fitted[Settings],
        controller: Controller,
        observations: int,
        source: Source[Any],
        episodes: int,
    ) -> None:
        self._writer, self._fitted, self._controller = writer, fitted, controller
        self._machine = fitted.settings.machine
        self._observations, self._episodes = observations, episodes
        played = Played(self._machine.frames, fitted.calls, controller.script)
        self._opens = source.play(played)
        # Once, and not on the writing thread: recordings decode a few pictures for it.
        self._content = list(source.content_notes())
        self._pending: deque[Future[Done]] = deque()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(torch_threads(self._controller.threads))
            # Two groups of players: one simulates while the model infers for the other, see `EpisodeLoop`.
            count = 2 * self._observations
            self._players = [self._open_player(position, stack) for position in range(count)]
            self._free: SimpleQueue[EpisodeBuffers] = SimpleQueue()
            for _ in range(count + SPARE_BUFFERS):
                self._free.put(self._make_buffers())
            # One thread: the writer remembers what it wrote of certificate and provenance, without a lock.
            self._thread = stack.enter_context(ThreadPoolExecutor(1, "probe-kit-writer"))
            # If a line above raised, the stack has closed what was open; from here on `__exit__` does.
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def _open_player(self, position: int, stack: ExitStack) -> AskablePlayer:
        processes = self._machine.env_workers
        if processes is None:
            processes = 2 * self._observations if self._episodes >= WORTH_PROCESSES else 0
        kind = ProcessPlayer if position < processes else LocalPlayer
        player = kind(self._opens)
        stack.callback(player.close)
        return player

    def _make_buffers(self) -> EpisodeBuffers:
        capture = self._fitted.settings.capture
        return EpisodeBuffers(
            self._writer.streams,
            self._fitted.calls,
            capture.tokens == "all",
            self._controller.on_gpu,
            capture.later_views,
        )

    def run(self, next_number: Callable[[], int | None]) -> Iterator[Event]:
        """Play what `next_number` returns, up to None; yield an event per episode when it is committed."""

        def next_episode() -> Row | None:
            number = next_number()
            return None if number is None else self._writer.plan.episode(number)

        playing = EpisodeLoop(self._players, self._controller, self._free, next_episode, self._is_filmed)
        for played in playing:
            if isinstance(played, Failed):
                yield played
            else:
                self._pending.append(self._thread.submit(self._write, *played))
            yield from self._write_episodes(wait=False)
        yield from self._write_episodes(wait=True)

    def _write_episodes(self, wait: bool) -> Iterator[Done]:
        while self._pending and (wait or self._pending[0].done()):
            yield self._pending.popleft().result()

    def _write(self, playing: Playing, ending: Ending) -> Done:
        """Write an episode, on the writing thread."""
        content = {INPUT_CONTENT: self._content} if self._content else {}
        try:
            return write_episode(self._writer, self._controller, self._fitted, playing, ending, content)
        finally:
            playing.buffers.clear()
            self._free.put(playing.buffers)

    def _is_filmed(self, planned: Row) -> bool:
        video = self._machine.video
        return video == "all" or (video == "first" and planned.index == 0)


def write_episode(
    writer: RunWriter,
    controller: Controller,
    fitted: Fitted[Settings],
    playing: Playing,
    ending: Ending,
    certified: Mapping[str, Any],
) -> Done:
    """Write an episode that was played to its end, with the certificate of this process before its first one.

    Args:
        writer: The writer of the run, which plans the episode.
        controller: The controller that inferred.
        fitted: The settings of the run.
        playing: The episode; its buffers are the caller's again afterwards.
        ending: Its ending.
        certified: Further entries of the certificate.
    """
    outcome, machine = playing.outcome(ending), fitted.settings.machine
    playing.buffers.wait()  # copies from a GPU may still be under way
    record = playing.buffers.record(
        playing.planned, outcome, trajectory=ending.trajectory, instruction_ids=playing.instruction_ids,
        control_steps=playing.control_steps, seconds=Seconds(playing.seconds, ending.seconds),
        inputs=ending.inputs or {}, pictures=_pictures(machine.frames, playing.planned, outcome, ending),
        frames=len(ending.small_frames) or None if machine.frames == "all" else None,
    )  # fmt: skip
    with writer.location.explained_errors():
        if not writer.is_certified:
            # Not before: the certificate holds fire counts and proofs, which the first inference gives.
            writer.write_certificate({**certificate_of(controller, fitted), **certified})
        writer.write(record)
    return Done(playing.planned.index, outcome)


def certificate_of(controller: Controller, fitted: Fitted[Settings]) -> dict[str, Any]:
    """Return the controller's certificate with the origin of this process."""
    certificate = controller.certificate()
    return {**certificate, ORIGIN: origin_of_process(fitted.settings, certificate["policy"]).to_json()}


def _pictures(frames: FrameChoice, planned: Row, outcome: Mapping[str, Any], ending: Ending) -> dict[str, bytes]:
    """Return the pictures that are kept for people, as content by key."""
    pictures = {}
    if ending.small_frames:
        pictures[thumbnail_key(planned.index)] = as_thumbnail(ending.small_frames, frames)
    if ending.frames:
        name = f"{planned.index:08d}-{planned.category}-{outcome['outcome']}.gif"
        pictures[f"{VIDEOS}/{name}"] = _film(ending.frames)
    return pictures


@contextmanager
def torch_threads(count: int | None) -> Iterator[None]:
    """Let torch use `count` threads in the body; None for its own choice."""
    # The calibration enters it too: another number of threads sums in another order, and rounds otherwise.
    if count is None:
        yield
        return
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _film(frames: Sequence[NDArray[np.uint8]]) -> bytes:
    """Return the frames as a GIF."""
    small = [np.asarray(Image.fromarray(frame).resize(_FILM_SIZE, Image.Resampling.LANCZOS)) for frame in frames]
    with tempfile.TemporaryDirectory() as folder:  # `save_gif` writes to paths, and a run may lie in a bucket
        save_gif(Path(folder) / "film.gif", small)
        return (Path(folder) / "film.gif").read_bytes()
