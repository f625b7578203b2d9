"""Workers on a Ray cluster."""

import json
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, Self

from probe_kit.cluster import ray_cluster
from probe_kit.errors import ProbeKitError
from probe_kit.extract.crews.loading import load_worker
from probe_kit.extract.crews.scheduler import Scheduler
from probe_kit.extract.play.events import Done, Event
from probe_kit.extract.settings import RunSettings
from probe_kit.extract.store.commits import commit_key
from probe_kit.extract.store.locate import locate

# Episodes per call, so that a worker always has something to simulate while it infers; fewer towards the end.
EPISODES_PER_CALL = 8


def run_on_ray(settings: RunSettings, run: str, scheduler: Scheduler, heard: Callable[[Event], None]) -> None:
    """Play the episodes in actors of a Ray cluster, one per GPU, all of which see the location `run`.

    An actor that dies is replaced; what it held is tried again by the scheduler, as in every transport.
    Raises MissingExtraError without Ray, UsageError if no cluster answers, and what an actor raises.
    """
    with RayCrew(settings, run) as crew:
        while not scheduler.finished:
            crew.hand_out(scheduler)
            for event in crew.collect(scheduler):
                heard(event)


class RayActor:
    """What runs on a node: the same worker as everywhere."""

    def __init__(self, settings: RunSettings, run: str) -> None:
        self._settings, self._run = settings, run
        self._opened = ExitStack()
        self._worker: Any = None

    def play(self, numbers: Sequence[int]) -> list[Event] | ProbeKitError:
        """Play and commit these episodes.

        What is wrong with the whole run is an answer: Ray would wrap it, and lose what is raised while starting.
        """
        ahead = iter(numbers)
        try:
            if self._worker is None:
                self._worker = self._opened.enter_context(load_worker(self._settings, self._run))
            return list(self._worker.run(lambda: next(ahead, None)))
        except ProbeKitError as error:
            return error


class RayCrew:
    """Actors on a cluster, as many as GPUs, or as `settings.workers` says. A context manager."""

    def __init__(self, settings: RunSettings, run: str) -> None:
        self._settings, self._run = settings, run
        self._playing: dict[Any, int] = {}

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._ray = ray = stack.enter_context(ray_cluster(self._settings.ray or "auto", log_to_driver=True))
            gpus = int(ray.cluster_resources().get("GPU", 0)) if self._settings.device.startswith("cuda") else 0
            # Ray could restart an actor itself, but fails every call meanwhile: episodes would seem to kill it
            # twice.
            options = {"num_gpus": 1 if gpus else 0, "max_restarts": 0, "max_task_retries": 0}
            self._kind = ray.remote(**options)(RayActor)
            self._actors = [self._start() for _ in range(self._settings.workers or max(1, gpus))]
            self._opened = stack.pop_all()
        return self

    def _start(self) -> Any:
        return self._kind.remote(self._settings, self._run)

    def __exit__(self, *_: object) -> None:
        with self._opened:
            for actor in self._actors:
                self._ray.kill(actor)

    def hand_out(self, scheduler: Scheduler) -> None:
        """Give every idle actor something to play."""
        for slot, actor in enumerate(self._actors):
            if slot not in self._playing.values():
                numbers = scheduler.take_some(slot, EPISODES_PER_CALL)
                if numbers:
                    self._playing[actor.play.remote(numbers)] = slot

    def collect(self, scheduler: Scheduler) -> list[Event]:
        """Wait for one actor and note what became of its episodes. Raises what is wrong with all of them."""
        (ready,), _ = self._ray.wait(list(self._playing), num_returns=1)
        slot = self._playing.pop(ready)
        try:
            answer: list[Event] | ProbeKitError = self._ray.get(ready)
        except self._ray.exceptions.RayActorError as error:
            self._ray.kill(self._actors[slot])  # it may live on behind a broken network
            self._actors[slot] = self._start()
            events = self._committed(scheduler.holds(slot))
            for event in events:
                scheduler.hear(slot, event)
            return [*events, *scheduler.lose(slot, f"its Ray actor died: {error}")]
        if isinstance(answer, ProbeKitError):
            raise answer
        for event in answer:
            scheduler.hear(slot, event)
        return answer

    def _committed(self, numbers: set[int]) -> list[Event]:
        """What a dead actor finished before it could say so."""
        location = locate(self._run)
        finished = [number for number in sorted(numbers) if location.exists(commit_key(number))]
        return [Done(number, json.loads(location.read(commit_key(number)))["outcome"]) for number in finished]
