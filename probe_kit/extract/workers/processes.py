"""Workers in processes of their own. Only episode numbers and outcomes are sent between processes."""

from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from signal import SIGALRM

from probe_kit._execution.process_pool import Ended, ProcessPool, share_of_machine
from probe_kit.errors import ProbeKitError, WorkerDiedError
from probe_kit.extract.rollout.events import Event
from probe_kit.extract.settings import Settings
from probe_kit.extract.workers.loading import load_worker
from probe_kit.extract.workers.scheduler import Scheduler
from probe_kit.extract.workers.worker_errors import tell_lost

MORE = "more"
_SERVICE = "probe_kit.extract.workers.processes:serve"


def run_in_processes(
    settings: Settings, run: str, scheduler: Scheduler, on_event: Callable[[Event], None]
) -> None:
    """Play the episodes in `settings.machine.workers` processes; one that dies is replaced.

    Raises what a worker raises, and WorkerDiedError if one dies before it could begin.
    """
    waiting: set[int] = set()
    began: set[int] = set()
    share = partial(share_of_machine, size=settings.machine.workers, device=settings.machine.device)
    with ProcessPool(_SERVICE, (settings, run), settings.machine.workers, share) as pool:
        while not scheduler.finished:
            for slot in sorted(waiting):
                number = scheduler.take(slot)
                if number is not None or scheduler.holds(slot):  # else there is none for now
                    waiting.discard(slot)
                    pool.send(slot, number)
            for slot, message in pool.receive():
                if isinstance(message, Ended):
                    _give_back(slot, _why(message.code, slot in began, slot, settings), scheduler, on_event)
                    waiting.discard(slot)
                    began.discard(slot)
                    pool.restart(slot)
                elif message == MORE:
                    waiting.add(slot)
                    began.add(slot)
                else:
                    scheduler.record(slot, message)
                    on_event(message)


def _why(code: int, began: bool, slot: int, settings: Settings) -> str:
    """How a worker ended. Raises WorkerDiedError for one that never began."""
    if not began:
        raise WorkerDiedError(
            f"worker {slot} ended with code {code} before its first episode; its last words are above. Try "
            "fewer --workers, or none to see the error in this process"
        )
    if settings.machine.inference_limit is not None and code == -SIGALRM:
        limit = f"{settings.machine.inference_limit:g}"
        return f"was ended, because a call of its model took longer than --inference-limit {limit} s"
    return f"ended with code {code}"


def _give_back(slot: int, why: str, scheduler: Scheduler, on_event: Callable[[Event], None]) -> None:
    tell_lost(f"worker {slot} {why}", len(scheduler.holds(slot)))
    for event in scheduler.lose(slot, f"the worker playing it {why}"):
        on_event(event)


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
