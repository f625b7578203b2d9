"""Playing in processes of this machine, one model each."""

from functools import partial
from multiprocessing.connection import Connection

from probe_kit._execution.process_pool import Ended, ProcessPool, share_of_machine
from probe_kit.errors import ProbeKitError, WorkerDiedError
from probe_kit.study.running.model_task import ModelTask, Report, play_model
from probe_kit.study.running.task_queue import MOST_LOSSES, TaskQueue, warn_of_loss

IDLE = "idle"
_SERVICE = "probe_kit.study.running.processes:serve"


def play_in_processes(tasks: list[ModelTask], slots: int, report: Report) -> None:
    """Play models in `slots` processes; one that dies is replaced, and its model resumes.

    With GPUs each process has one of its own; further processes play models that need none.
    Raises DiskSpaceError and StoreError of any process, and WorkerDiedError if processes die before they begin.
    """
    queue, idle, stillborn = TaskQueue(tasks), set[int](), 0
    device = "cuda" if any(task.gpus for task in tasks) else "cpu"
    size = min(slots, len(tasks))
    gpus = _gpus() if device == "cuda" else 0
    with ProcessPool(_SERVICE, None, size, partial(share_of_machine, size=size, device=device)) as pool:
        while not queue.finished:
            for slot in sorted(idle):
                task = queue.take(slot, slot < gpus)
                if task is not None:
                    idle.discard(slot)
                    pool.send(slot, task)
            if queue.finished:
                return
            for slot, message in pool.receive():
                if isinstance(message, Ended):
                    stillborn = _lost(queue, slot, message.code, stillborn, report)
                    idle.discard(slot)
                    pool.restart(slot)
                elif message == IDLE:
                    stillborn = 0
                    queue.end(slot)
                    idle.add(slot)
                else:
                    queue.note(slot, message)
                    report(message)


def _lost(queue: TaskQueue, slot: int, code: int, stillborn: int, report: Report) -> int:
    """Give back what a process held. Returns how many ended one after another before they began."""
    held = queue.holds(slot)
    if held is None:
        if stillborn + 1 >= MOST_LOSSES:
            raise WorkerDiedError(f"{MOST_LOSSES} processes ended with code {code} before they began; see above")
        return stillborn + 1
    warn_of_loss(f"process {slot}, which played {held.model}, ended with code {code}")
    failure = queue.lose(slot, f"its process ended with code {code}")
    if failure is not None:
        report(failure)
    return 0


def _gpus() -> int:
    import torch

    return torch.cuda.device_count()


def serve(connection: Connection) -> None:
    """A process's side: a model after the other until the parent hangs up."""
    connection.recv()
    while True:
        connection.send(IDLE)
        task: ModelTask = connection.recv()
        try:
            play_model(task, connection.send)
        except ProbeKitError as error:
            connection.send(error)
