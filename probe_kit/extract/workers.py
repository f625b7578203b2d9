"""Workers that play episodes: in this process, in processes of their own, or as actors on a Ray cluster."""

from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from signal import SIGALRM
from typing import Any

from probe_kit._execution.executor import GivenUp, Pool, TaskQueue, work_off
from probe_kit._execution.process_pool import ProcessPool, share_of_machine
from probe_kit._execution.ray_pool import RayPool
from probe_kit.extract.events import Done, Event, Failed
from probe_kit.extract.plan import Plan
from probe_kit.extract.preparation import Prepared, load
from probe_kit.extract.rollout.worker import Worker
from probe_kit.extract.settings import Settings
from probe_kit.runs.store import locate
from probe_kit.runs.writer import RunWriter


def play(prepared: Prepared, writer: RunWriter[Plan], numbers: list[int]) -> Generator[Event]:
    """Play episodes where the settings say; yields `Done` of each, or `Failed` once it is given up.

    In this process with the model that is loaded, else in workers with one of their own, to which only episode
    numbers are sent. An episode that fails, or is lost with its worker, is tried once more.
    Raises what a worker raises, WorkerDiedError if workers die before they begin, MissingExtraError without Ray,
    and UsageError if no cluster answers.
    """
    queue = TaskQueue(((number, number) for number in numbers), "episode")
    settings = prepared.settings
    if settings.machine.ray or settings.machine.workers:
        events = work_off(_pool(settings, writer.location.address), queue)
    else:
        events = _played_here(prepared, writer, queue, len(numbers))
    for slot, event in events:
        if isinstance(event, GivenUp):
            yield Failed(event.task, f"the worker that played it was lost: {event.reason}")
        elif isinstance(event, Done):
            queue.end(slot, event.number)
            yield event
        elif not queue.retry(slot, event.number):
            yield event


def play_episodes(
    setup: tuple[Settings, str], take: Callable[[], int | None], report: Callable[[Event], None]
) -> None:
    """The work of a worker elsewhere: load the model, then play what is handed out."""
    with load_worker(*setup) as worker:
        while True:
            for event in worker.run(take):
                report(event)


@contextmanager
def load_worker(settings: Settings, run: str) -> Iterator[Worker]:
    """A worker for a run that exists, with a model of its own; the run is held while the body runs.

    Raises SettingsMismatchError if they differ, or if this machine gives other numbers than those before it.
    """
    prepared = load(settings, rehearsed=True)
    assert prepared.controller is not None
    writer = prepared.writer(locate(run))
    with writer.joined():
        writer.begin(settings.machine.allow_mixed)
        episodes = len(writer.remaining())
        with Worker(writer, prepared.settings, prepared.controller, prepared.source, episodes) as worker:
            yield worker


def _played_here(
    prepared: Prepared, writer: RunWriter[Plan], queue: TaskQueue[int], episodes: int
) -> Iterator[tuple[int, Event]]:
    assert prepared.controller is not None
    with Worker(writer, prepared.settings, prepared.controller, prepared.source, episodes) as worker:
        while not queue.finished:
            yield from ((0, event) for event in worker.run(lambda: queue.take(0)))


def _pool(settings: Settings, run: str) -> Pool:
    if settings.machine.ray:
        return RayPool(play_episodes, (settings, run), settings.machine.ray, partial(_gpus, settings))
    share = partial(share_of_machine, size=settings.machine.workers, device=settings.machine.device)
    limit = settings.machine.inference_limit
    exits = {
        -SIGALRM: f"was ended, because a call of its model took longer than --inference-limit {limit:g} s"
    } if limit is not None else None  # fmt: skip
    return ProcessPool(play_episodes, (settings, run), settings.machine.workers, share, exits)


def _gpus(settings: Settings, resources: Mapping[str, Any]) -> list[int]:
    """The GPUs of each actor: as many actors as GPUs, or as the settings say."""
    gpus = int(resources.get("GPU", 0)) if settings.machine.device.startswith("cuda") else 0
    return [1 if gpus else 0] * (settings.machine.workers or max(1, gpus))
