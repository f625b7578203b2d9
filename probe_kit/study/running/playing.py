"""Playing of models: in this process, in processes of this machine, or on a Ray cluster."""

from collections.abc import Callable
from functools import partial
from typing import Any

from probe_kit._execution.executor import GivenUp, Pool, TaskQueue, work_off
from probe_kit._execution.process_pool import ProcessPool, share_of_machine
from probe_kit._execution.ray_pool import RayPool
from probe_kit.study.ledger import Failure, now
from probe_kit.study.running.model_task import Event, Made, ModelTask, Moved, Report, play_model

MOST_LOSSES = 3
"""Workers of a model that may be lost one after another without an episode in between."""


def play_models(tasks: list[ModelTask], report: Report, slots: int = 0, ray: str | None = None) -> None:
    """Play models one after the other here, in `slots` processes, or on the cluster `ray`.

    The longest goes first. A model whose worker is lost resumes after what is stored; it fails once it was lost
    `MOST_LOSSES` times without an episode in between. With GPUs each process has one of its own; further processes
    play models that need none. Ray finds room for each model; its nodes see the runs.
    Raises DiskSpaceError and StoreError of any worker, WorkerDiedError if workers die before they begin,
    MissingExtraError without Ray, and UsageError if no cluster answers.
    """
    tasks = sorted(tasks, key=lambda task: -task.size)
    if ray is None and not slots:
        for task in tasks:
            play_model(task, report)
        return
    pool, fits = _on_ray(tasks, ray) if ray is not None else _in_processes(tasks, min(slots, len(tasks)))
    queue = TaskQueue(((task.model, task) for task in tasks), "model", MOST_LOSSES, fits)
    for slot, event in work_off(pool, queue):
        _note(queue, slot, event, report)


def play_here(_setup: None, take: Callable[[], ModelTask], report: Callable[[Event | ModelTask], None]) -> None:
    """The work of a worker elsewhere: one model after the other, each of which is reported when it is played."""
    while True:
        task = take()
        play_model(task, report)
        report(task)


def _note(queue: TaskQueue[ModelTask], slot: int, event: Any, report: Report) -> None:
    """Note and report an event: what is made or given up is not played again."""
    if isinstance(event, GivenUp):
        report(_lost_too_often(event))
    elif isinstance(event, ModelTask):
        queue.end(slot, event.model)
    else:
        if isinstance(event, Moved):
            queue.advanced(event.model)
        elif isinstance(event, Made) or event.stage == "episodes":
            rest = queue.holds(slot)[event.model].without([event.run])
            queue.replace(slot, event.model, rest)
        report(event)


def _lost_too_often(event: GivenUp[ModelTask]) -> Failure:
    reason = f"{event.reason}, {MOST_LOSSES} times without an episode in between. Its last words are above"
    model, run = event.task.model, event.task.runs[0].run
    return Failure(stage="playing", model=model, run=run, reason=reason, error="WorkerDiedError", when=now())


def _in_processes(tasks: list[ModelTask], size: int) -> tuple[Pool, Callable[[int, ModelTask], bool]]:
    device, gpus = "cpu", 0
    if any(task.gpus for task in tasks):
        import torch

        device, gpus = "cuda", torch.cuda.device_count()
    pool = ProcessPool(play_here, None, size, partial(share_of_machine, size=size, device=device))
    return pool, lambda slot, task: slot < gpus or not task.gpus


def _on_ray(tasks: list[ModelTask], address: str) -> tuple[Pool, Callable[[int, ModelTask], bool]]:
    """A worker for every model, with the GPUs that it needs."""
    gpus = [task.gpus for task in tasks]
    return RayPool(play_here, None, address, lambda _cluster: gpus), lambda slot, task: gpus[slot] == task.gpus
