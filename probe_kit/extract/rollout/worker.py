"""A worker: plays its episodes and commits them, in this process or in another."""

import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from PIL import Image

from probe_kit.env import save_gif
from probe_kit.extract.events import Done, Event, Failed
from probe_kit.extract.plan import Plan, Row
from probe_kit.extract.rollout.controllers import Controller
from probe_kit.extract.rollout.episode_buffers import BufferPool, EpisodeBuffers
from probe_kit.extract.rollout.episode_loop import EpisodeLoop, Failure, Rollout
from probe_kit.extract.settings import Settings
from probe_kit.extract.sources.player import AskablePlayer, LocalPlayer, ProcessPlayer
from probe_kit.extract.sources.source import Played, Source
from probe_kit.runs.layout import VIDEOS
from probe_kit.runs.origin import ORIGIN, Origin
from probe_kit.runs.thumbnails import as_thumbnail, thumbnail_key
from probe_kit.runs.writer import RunWriter

# Buffers beyond one per player: one is being written while another waits.
SPARE_BUFFERS = 2
# With fewer episodes than this, starting processes takes longer than they save.
WORTH_PROCESSES = 8
# Width and height of a GIF, for people alone: a quarter of the pixels of the default camera.
_FILM_SIZE = (320, 240)


class Worker:
    """Plays and commits episodes; a context manager, because it holds simulators and a writing thread.

    Episodes are written by one thread while the next ones are played. An error in it is raised with the next
    episode; on leaving, whatever was handed to it is written first.
    """

    def __init__(
        self,
        writer: RunWriter[Plan],
        settings: Settings,
        controller: Controller,
        source: Source[Any],
        episodes: int,
    ) -> None:
        self._writer, self._settings, self._controller = writer, settings, controller
        self._episodes = episodes
        played = Played(settings.machine.frames, settings.capture.calls, controller.script)
        self._opens = source.play(played)
        self._pending: deque[Future[Done]] = deque()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(torch_threads(self._controller.threads))
            # Two groups of players: one simulates while the model infers for the other, see `EpisodeLoop`.
            count = 2 * self._settings.machine.observations
            self._players = [self._open_player(position, stack) for position in range(count)]
            self._ring = BufferPool([self._make_buffers() for _ in range(count + SPARE_BUFFERS)])
            # One thread: the writer remembers what it wrote of certificate and provenance, without a lock.
            self._thread = stack.enter_context(ThreadPoolExecutor(1, "probe-kit-writer"))
            # If a line above raised, the stack has closed what was open; from here on `__exit__` does.
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def _open_player(self, position: int, stack: ExitStack) -> AskablePlayer:
        processes = self._settings.machine.env_workers
        if processes is None:
            processes = 2 * self._settings.machine.observations if self._episodes >= WORTH_PROCESSES else 0
        kind = ProcessPlayer if position < processes else LocalPlayer
        player = kind(self._opens)
        stack.callback(player.close)
        return player

    def _make_buffers(self) -> EpisodeBuffers:
        settings, controller = self._settings, self._controller
        with_tokens = settings.capture.tokens == "all"
        return EpisodeBuffers(
            self._writer.streams,
            settings.capture.calls,
            with_tokens,
            controller.on_gpu,
            settings.capture.later_views,
        )

    def run(self, next_number: Callable[[], int | None]) -> Iterator[Event]:
        """Play what `next_number` gives until it gives None; an event per episode, when it is committed."""

        def next_episode() -> Row | None:
            number = next_number()
            return None if number is None else self._writer.plan.episode(number)

        playing = EpisodeLoop(self._players, self._controller, self._ring, next_episode, self._is_filmed)
        for played in playing:
            if isinstance(played, Failure):
                yield Failed(played.planned.index, played.reason, played.traceback)
            else:
                self._pending.append(self._thread.submit(self._write, played))
            yield from self._written(wait=False)
        yield from self._written(wait=True)

    def _written(self, wait: bool) -> Iterator[Done]:
        while self._pending and (wait or self._pending[0].done()):
            yield self._pending.popleft().result()

    def _write(self, rollout: Rollout) -> Done:
        """On the writing thread."""
        try:
            rollout.buffers.wait()  # copies from a GPU may still be under way
            with self._writer.location.in_words():
                # Not before: the certificate holds fire counts and proofs, which the first inference gives.
                self._writer.write_certificate(self._certificate())
                self._writer.write(
                    replace(rollout.record, pictures=self._pictures(rollout), frames=self._frame_count(rollout))
                )
        finally:
            self._ring.give_back(rollout.buffers)
        return Done(rollout.planned.index, rollout.outcome)

    def _certificate(self) -> dict[str, Any]:
        """The controller's, and the origin of this process."""
        certificate = self._controller.certificate()
        card = certificate["policy"]
        checkpoint, repositories = str(card.get("checkpoint") or ""), card.get("repositories", {})
        origin = Origin.of(self._settings.model, self._settings.source.files(), checkpoint, repositories)
        return {**certificate, ORIGIN: origin.to_json()}

    def _pictures(self, rollout: Rollout) -> dict[str, bytes]:
        """Content by key of what is kept for people."""
        small = rollout.small_frames
        thumbnails = (
            {thumbnail_key(rollout.planned.index): as_thumbnail(small, self._settings.machine.frames)}
            if small
            else {}
        )
        return thumbnails | (dict([_film(rollout)]) if rollout.frames else {})

    def _frame_count(self, rollout: Rollout) -> int | None:
        return len(rollout.small_frames) or None if self._settings.machine.frames == "all" else None

    def _is_filmed(self, planned: Row) -> bool:
        return self._settings.machine.video == "all" or (
            self._settings.machine.video == "first" and planned.index == 0
        )


@contextmanager
def torch_threads(count: int | None) -> Iterator[None]:
    """Let torch use so many threads in the body; None for its own choice."""
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


def _film(rollout: Rollout) -> tuple[str, bytes]:
    frames = [
        np.asarray(Image.fromarray(frame).resize(_FILM_SIZE, Image.Resampling.LANCZOS)) for frame in rollout.frames
    ]
    planned = rollout.planned
    name = f"{planned.index:08d}-{planned.category}-{rollout.outcome['outcome']}.gif"
    with tempfile.TemporaryDirectory() as folder:  # `save_gif` writes to paths, and a run may lie in a bucket
        save_gif(Path(folder) / name, frames)
        return f"{VIDEOS}/{name}", (Path(folder) / name).read_bytes()
