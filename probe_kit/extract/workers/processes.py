"""Workers in processes of their own. Only episode numbers and outcomes are sent between processes."""

import os
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from signal import SIGALRM

from probe_kit._system.child_process import Child
from probe_kit.errors import ProbeKitError, WorkerDiedError
from probe_kit.extract.rollout.events import Event
from probe_kit.extract.settings import RunSettings
from probe_kit.extract.workers.loading import load_worker
from probe_kit.extract.workers.scheduler import Scheduler
from probe_kit.extract.workers.worker_errors import tell_lost

MORE = "more"


def run_in_processes(
    settings: RunSettings, run: str, scheduler: Scheduler, on_event: Callable[[Event], None]
) -> None:
    """Play the episodes in `settings.workers` processes; one that dies is replaced.

    Raises what a worker raises, and WorkerDiedError if one dies before it could begin.
    """
    workers = [_Hand(slot, settings, run) for slot in range(settings.workers)]
    try:
        while not scheduler.finished:
            for hand in workers:
                hand.offer(scheduler)
            ready = wait([hand.connection for hand in workers])
            for hand in workers:
                if hand.connection in ready:
                    _receive(hand, scheduler, on_event)
    finally:
        for hand in workers:
            hand.connection.close()  # all of them, so that they end side by side
        for hand in workers:
            hand.close()


class _Hand:
    """The driver's view of one worker process."""

    def __init__(self, slot: int, settings: RunSettings, run: str) -> None:
        self.slot, self._settings, self._run = slot, settings, run
        self.limit = settings.inference_limit
        self.start()

    def start(self) -> None:
        """Start the process; it loads the model by itself."""
        self.waiting = self.began = False
        self._child = Child("probe_kit.extract.workers.processes:serve", _environment(self.slot, self._settings))
        self._child.connection.send((self._settings, self._run))

    @property
    def connection(self) -> Connection:
        """What the worker says."""
        return self._child.connection

    def offer(self, scheduler: Scheduler) -> None:
        """Answer a worker that asked for an episode, unless it has nothing else and there is none for now."""
        if not self.waiting:
            return
        number = scheduler.take(self.slot)
        if number is not None or scheduler.holds(self.slot):
            self.waiting = False
            with suppress(BrokenPipeError, ConnectionResetError):  # then the next `recv` finds it dead
                self.connection.send(number)

    def close(self) -> int:
        """End the process; what it has played is written first."""
        return self._child.close()


def _receive(hand: _Hand, scheduler: Scheduler, on_event: Callable[[Event], None]) -> None:
    try:
        message = hand.connection.recv()
    except (EOFError, ConnectionResetError):
        _replace(hand, scheduler, on_event)
        return
    if isinstance(message, ProbeKitError):
        raise message
    if message == MORE:
        hand.waiting = hand.began = True
    else:
        scheduler.record(hand.slot, message)
        on_event(message)


def _replace(hand: _Hand, scheduler: Scheduler, on_event: Callable[[Event], None]) -> None:
    code = hand.close()
    if not hand.began:
        raise WorkerDiedError(
            f"worker {hand.slot} ended with code {code} before its first episode; its last words are above. Try "
            "fewer --workers, or none to see the error in this process"
        )
    why = _why(code, hand.limit)
    tell_lost(f"worker {hand.slot} {why}", len(scheduler.holds(hand.slot)))
    for event in scheduler.lose(hand.slot, f"the worker playing it {why}"):
        on_event(event)
    hand.start()


def _why(code: int, limit: float | None) -> str:
    if limit is not None and code == -SIGALRM:
        return f"was ended, because a call of its model took longer than --inference-limit {limit:g} s"
    return f"ended with code {code}"


def _environment(slot: int, settings: RunSettings) -> dict[str, str]:
    """One GPU per worker where there are GPUs, and a fair share of the cores."""
    share = max(1, (os.cpu_count() or 1) // settings.workers)
    environment = {"OMP_NUM_THREADS": str(share)}
    if settings.device.startswith("cuda"):
        import torch

        environment["CUDA_VISIBLE_DEVICES"] = str(slot % max(1, torch.cuda.device_count()))
    return environment


def serve(connection: Connection) -> None:
    """A worker's side: load the model, then play what the driver hands out until it hangs up."""
    settings, run = connection.recv()

    def ask() -> int | None:
        connection.send(MORE)
        number: int | None = connection.recv()
        return number

    try:
        with load_worker(settings, run) as worker:
            while True:
                for event in worker.run(ask):
                    connection.send(event)
    except ProbeKitError as error:
        connection.send(error)
