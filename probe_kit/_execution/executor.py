"""The executor: it gives tasks to workers, here or elsewhere, and repeats the tasks of a lost worker."""

import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, Self

from probe_kit.errors import ProbeKitError, UsageError, WorkerDiedError

Work = Callable[[Any, Callable[[], Any], Callable[[Any], None]], None]
"""The work of a worker: a function of a module with the arguments (setup, take, report).

It gets `setup` as the executor was given it. `take` waits for the next task; it returns None if a worker that
still works on a task should finish it first. `report` sends an event. The function never returns; it ends with its
process.
"""


class Connection(Protocol):
    """A pipe to the executor."""

    def send(self, message: Any, /) -> None:
        """Send a message."""

    def recv(self) -> Any:
        """Wait for a message."""


@dataclass(frozen=True)
class IdleMessage:
    """The message of a worker that waits for a task."""


@dataclass(frozen=True)
class Lost:
    """The message of a pool about a worker that is gone.

    Attributes:
        worker: The worker, as a sentence names it.
        why: The predicate of that sentence.
        counts: False for a loss that is no sign against the tasks of the worker, such as that of a whole node.
    """

    worker: str
    why: str
    counts: bool = True

    def __str__(self) -> str:
        return f"{self.worker} {self.why}"


def serve(connection: Connection) -> None:
    """Do the work that the first message names; a ProbeKitError is sent as a message."""
    work, setup = connection.recv()

    def take() -> Any:
        connection.send(IdleMessage())
        return connection.recv()

    try:
        work(setup, take, connection.send)
    except ProbeKitError as error:
        connection.send(error)


# -- the executor ---------------------------------------------------------------------------------------------

MOST_STILLBORN = 3
"""Workers that die in a row before their first task, at which the executor gives up: so many are no accident."""
_NAMED_TASKS = 3
"""The number of a lost worker's tasks that the warning names."""


class WorkerLostWarning(UserWarning):
    """A warning that a worker died in mid-run; what it had not finished is tried again. No number changes."""


class Pool(Protocol):
    """Workers, here or elsewhere; see `ProcessPool` and `RayPool`."""

    def __enter__(self) -> Self: ...
    def __exit__(self, *_: object) -> None: ...
    @property
    def slots(self) -> set[int]:
        """The numbers of the workers."""

    def start(self, slot: int) -> None:
        """Start a worker again."""

    def stop(self, slot: int) -> None:
        """End an idle worker."""

    def send(self, slot: int, message: object) -> None:
        """Send a task to a worker."""

    def receive(self) -> Iterator[tuple[int, Any]]:
        """Wait for messages of workers, and yield each with the number of its worker."""


@dataclass(frozen=True)
class GivenUp[T]:
    """The event of a task that was lost with its worker once too often."""

    task: T
    reason: str


class TaskQueue[T]:
    """Tasks for workers, handed out in order.

    A task that failed, or was in the hands of a worker that died, is suspect. It is tried again when all others
    are handed out, by a worker that holds nothing else. So it can take no other task down with it.

    Args:
        tasks: Keys and tasks in order, of which one is read ahead.
        noun: A word for one task, in the singular, as messages name it.
        tries: The number of failures after which a task is given up.
        fits: Whether a worker, by number, can do a task; all tasks are then read at once. None: every worker can
            do each.
    """

    def __init__(
        self, tasks: Iterable[tuple[Hashable, T]], noun: str, tries: int = 2,
        fits: Callable[[int, T], bool] | None = None,
    ) -> None:  # fmt: skip
        self.noun = noun
        self._unread, self._tries, self._fits = iter(tasks), tries, fits
        self._fresh: dict[Hashable, T] = {} if fits is None else dict(self._unread)
        self._suspects: dict[Hashable, T] = {}
        self._held: dict[int, dict[Hashable, T]] = defaultdict(dict)
        self._failures: Counter[Hashable] = Counter()
        self._read = False

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do or in the hands of a worker."""
        self.read_ahead()
        return not (self._fresh or self._suspects or any(self._held.values()))

    def read_ahead(self) -> None:
        """Read the next task, so that it is ready when a worker asks for it."""
        if not self._fresh and not self._read:
            self._fresh = dict([task]) if (task := next(self._unread, None)) else {}
            self._read = not self._fresh

    def take(self, slot: int) -> T | None:
        """Return the next task for a worker; None if it should finish the tasks it has, or wait."""
        tasks = self._held[slot]
        if any(key in self._failures for key in tasks):  # it holds a suspect, which takes no other task down
            return None
        self.read_ahead()
        for waiting in (self._fresh, {} if tasks else self._suspects):
            for key, task in waiting.items():
                if self._fits is None or self._fits(slot, task):
                    tasks[key] = waiting.pop(key)
                    return task
        return None

    def holds(self, slot: int) -> dict[Hashable, T]:
        """Return the tasks in the hands of a worker, by key."""
        return dict(self._held[slot])

    def end(self, slot: int, key: Hashable) -> None:
        """Note that a worker is done with a task."""
        self._held[slot].pop(key, None)

    def replace(self, slot: int, key: Hashable, task: T) -> None:
        """Replace a task in the hands of a worker by what is left of it."""
        if key in self._held[slot]:
            self._held[slot][key] = task

    def advanced(self, key: Hashable) -> None:
        """Note that a task advances: its failures so far no longer count."""
        self._failures.pop(key, None)

    def retry(self, slot: int, key: Hashable, counts: bool = True) -> bool:
        """Take a task that failed back from a worker, and return whether it is tried again.

        Args:
            slot: The number of the worker.
            key: The key of the task.
            counts: False for a failure that is no sign against the task.
        """
        task = self._held[slot].pop(key)
        self._failures[key] += counts  # an entry, also of 0, makes the task a suspect
        if self._failures[key] < self._tries:
            self._suspects[key] = task
            return True
        return False


def work_off[T](pool: Pool, queue: TaskQueue[T]) -> Iterator[tuple[int, Any]]:
    """Let the workers of a pool do all tasks of a queue; yield a worker's number with each event, as they come.

    The caller ends every task in the queue, and retries what fails. A worker that dies is replaced, with a
    warning; a task that is lost once too often is the event `GivenUp`. A worker without further tasks is stopped.

    Raises:
        ProbeKitError: The error that a worker sends.
        WorkerDiedError: If `MOST_STILLBORN` workers in a row die before their first task.
        UsageError: If no worker can take a task that is left.
    """
    if queue.finished:
        return
    idle, begun, stillborn = set[int](), set[int](), 0
    with pool:
        while not queue.finished:
            _hand_out(pool, queue, idle)
            queue.read_ahead()
            for slot, message in pool.receive():
                if isinstance(message, ProbeKitError):
                    raise message
                if isinstance(message, IdleMessage):
                    idle.add(slot)
                    begun.add(slot)
                    stillborn = 0
                elif isinstance(message, Lost):
                    stillborn += slot not in begun and message.counts
                    if stillborn >= MOST_STILLBORN:
                        raise WorkerDiedError(_died_early(message))
                    idle.discard(slot)
                    begun.discard(slot)
                    pool.start(slot)
                    yield from ((slot, given_up) for given_up in _take_back(queue, slot, message))
                else:
                    yield slot, message


def _hand_out(pool: Pool, queue: TaskQueue[Any], idle: set[int]) -> None:
    for slot in sorted(idle):
        task = queue.take(slot)
        idle.discard(slot)
        if task is not None or queue.holds(slot):  # None: it finishes what it holds
            pool.send(slot, task)
        else:
            pool.stop(slot)
    if not pool.slots:
        raise UsageError(f"no worker can take a {queue.noun} that is left: none of them has what it needs")


def _take_back[T](queue: TaskQueue[T], slot: int, lost: Lost) -> Iterator[GivenUp[T]]:
    tasks = queue.holds(slot)
    names = [*map(str, tasks)][:_NAMED_TASKS] + ["…"] * (len(tasks) > _NAMED_TASKS)
    count = f"{len(tasks)} {queue.noun}s" if len(tasks) > 1 else f"the {queue.noun}"
    again = f"{count} it held ({', '.join(names)}) will be tried again" if tasks else f"it held no {queue.noun}"
    warnings.warn(f"{lost}; {again}", WorkerLostWarning, stacklevel=3)
    for key, task in tasks.items():
        if not queue.retry(slot, key, lost.counts):
            yield GivenUp(task, str(lost))


def _died_early(lost: Lost) -> str:
    return (
        f"{MOST_STILLBORN} workers in a row ended before their first task; the last one: {lost}. Their last words "
        "are above. Fewer workers take less memory; without workers the error shows in this process"
    )
