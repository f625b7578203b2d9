"""Playing on a Ray cluster: one task per model, with the GPUs that it needs, on one connection for the study."""

from contextlib import suppress
from typing import Any

from probe_kit._execution.ray_cluster import answer_of, ray_cluster
from probe_kit._system.optional_dependencies import require
from probe_kit.errors import ProbeKitError
from probe_kit.study.running.model_task import ModelTask, Report, play_model
from probe_kit.study.running.task_queue import TaskQueue, warn_of_loss

TURN_S = 0.5
"""Seconds after which events are reported, if no model ends before."""

_HEAD = "node:__internal_head__"
"""What Ray calls the resource that the head node alone has."""


def play_on_ray(tasks: list[ModelTask], address: str, report: Report) -> None:
    """Play models on the nodes of a cluster, all of which see the runs' location; Ray finds room for each.

    A model whose node or process is lost resumes elsewhere. Raises MissingExtraError without Ray, UsageError if
    no cluster answers, and DiskSpaceError and StoreError of any node.
    """
    with ray_cluster(address, log_to_driver=True) as ray:
        crew = _Crew(ray, TaskQueue(tasks), report)
        try:
            while not crew.finished:
                crew.hand_out()
                crew.collect()
        finally:
            crew.close()


def play_there(place: int, task: ModelTask, events: Any) -> ProbeKitError | None:
    """On a node. What stops the study is an answer: Ray would wrap what is raised."""
    try:
        play_model(task, lambda event: events.put((place, event)))
    except ProbeKitError as error:
        return error
    return None


class _Crew:
    """Tasks on the cluster. Events come through a queue on the head node, without which there is no cluster."""

    def __init__(self, ray: Any, queue: TaskQueue, report: Report) -> None:
        self._ray, self._queue, self._report = ray, queue, report
        self._calls: dict[Any, int] = {}
        self._alive_at: dict[int, set[str]] = {}
        """By place, the nodes that were alive when it was handed its model."""
        self._places = 0
        head = {"num_cpus": 0, "resources": {_HEAD: 0.001}}
        self._events = require("ray.util.queue", "ray").Queue(actor_options=head)
        # A retry by Ray would know nothing of the runs that are made already.
        self._play = ray.remote(max_retries=0, num_cpus=1, scheduling_strategy="SPREAD")(play_there)

    @property
    def finished(self) -> bool:
        """Whether nothing is left to play or in play."""
        return self._queue.finished

    def hand_out(self) -> None:
        """Hand all waiting models to Ray, which holds them until there is room, in this order."""
        while (task := self._queue.take(self._places)) is not None:
            self._alive_at[self._places] = self._alive()
            call = self._play.options(num_gpus=task.gpus).remote(self._places, task, self._events)
            self._calls[call] = self._places
            self._places += 1

    def collect(self) -> None:
        """Wait a turn; report what happened and note which models ended. Raises what stops the study."""
        ready, _ = self._ray.wait(list(self._calls), num_returns=1, timeout=TURN_S)
        self._report_events()
        for call in ready:
            place = self._calls.pop(call)
            try:
                answer_of(self._ray, call)
            except self._ray.exceptions.RayError as error:
                self._lost(place, error)
            else:
                self._queue.end(place)

    def _report_events(self) -> None:
        for _ in range(self._events.qsize()):
            place, event = self._events.get()
            self._queue.note(place, event)
            self._report(event)

    def _lost(self, place: int, error: Exception) -> None:
        held = self._queue.holds(place)
        said = str(error).partition("\n")[0]
        warn_of_loss(
            f"the node or process of the Ray cluster that played {held.model if held else ''} is lost: {said}"
        )
        # Until Ray knows of a lost node it sends tasks there that never run.
        failure = self._queue.lose(
            place, f"it was lost on the Ray cluster ({said})", self._alive_at[place] <= self._alive()
        )
        if failure is not None:
            self._report(failure)

    def _alive(self) -> set[str]:
        return {node["NodeID"] for node in self._ray.nodes() if node["Alive"]}

    def close(self) -> None:
        """End what is still in play, which loses nothing that is committed."""
        for call in self._calls:
            with suppress(self._ray.exceptions.RayError, ValueError):
                self._ray.cancel(call, force=True)
        self._events.shutdown(force=True)
