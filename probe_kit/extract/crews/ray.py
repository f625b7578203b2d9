"""Workers on a Ray cluster."""

import json
from collections.abc import Sequence
from typing import Any, Self

from probe_kit.extract.crews.scheduler import Done, Event, Scheduler
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.store.commits import commit_key
from probe_kit.extract.store.location import locate
from probe_kit.extras import require

# Episodes per call, so that a worker always has something to simulate while it infers; fewer towards the end.
EPISODES_PER_CALL = 8


class RayActor:
    """What runs on a node: the same worker as everywhere."""

    def __init__(self, settings: ExtractSettings, run: str) -> None:
        from probe_kit.extract.extraction import load_worker

        self._worker = load_worker(settings, run).__enter__()

    def play(self, numbers: Sequence[int]) -> list[Event]:
        """Play and commit these episodes."""
        ahead = iter(numbers)
        return list(self._worker.run(lambda: next(ahead, None)))


class RayCrew:
    """Actors on a cluster, as many as GPUs, or as `settings.workers` says. A context manager.

    Raises MissingExtraError if Ray is not installed.
    """

    def __init__(self, settings: ExtractSettings, run: str) -> None:
        self._ray = require("ray", "ray")
        self._settings, self._run = settings, run
        self._playing: dict[Any, int] = {}

    def __enter__(self) -> Self:
        self._started = not self._ray.is_initialized()
        if self._started:
            address = None if self._settings.ray == "auto" else self._settings.ray
            self._ray.init(address=address, include_dashboard=False, log_to_driver=True)
        gpus = int(self._ray.cluster_resources().get("GPU", 0)) if self._settings.device.startswith("cuda") else 0
        # Ray could restart an actor itself, but fails every call meanwhile: episodes would seem to kill it twice.
        options = {"num_gpus": 1 if gpus else 0, "max_restarts": 0, "max_task_retries": 0}
        self._kind = self._ray.remote(**options)(RayActor)
        self._actors = [self._start() for _ in range(self._settings.workers or max(1, gpus))]
        return self

    def _start(self) -> Any:
        return self._kind.remote(self._settings, self._run)

    def __exit__(self, *_: object) -> None:
        for actor in self._actors:
            self._ray.kill(actor)
        if self._started:
            self._ray.shutdown()

    def hand_out(self, scheduler: Scheduler) -> None:
        """Give every idle actor something to play."""
        for slot, actor in enumerate(self._actors):
            if slot not in self._playing.values():
                numbers = scheduler.take_some(slot, EPISODES_PER_CALL)
                if numbers:
                    self._playing[actor.play.remote(numbers)] = slot

    def collect(self, scheduler: Scheduler) -> list[Event]:
        """Wait for one actor and note what became of its episodes."""
        (ready,), _ = self._ray.wait(list(self._playing), num_returns=1)
        slot = self._playing.pop(ready)
        try:
            events: list[Event] = self._ray.get(ready)
        except self._ray.exceptions.RayActorError as error:
            self._ray.kill(self._actors[slot])  # it may live on behind a broken network
            self._actors[slot] = self._start()
            events = self._committed(scheduler.holds(slot))
            for event in events:
                scheduler.hear(slot, event)
            return [*events, *scheduler.lose(slot, f"its Ray actor died: {error}")]
        for event in events:
            scheduler.hear(slot, event)
        return events

    def _committed(self, numbers: set[int]) -> list[Event]:
        """What a dead actor finished before it could say so."""
        location = locate(self._run)
        finished = [number for number in sorted(numbers) if location.exists(commit_key(number))]
        return [Done(number, json.loads(location.read(commit_key(number)))["outcome"]) for number in finished]
