"""Probe fits in processes on this machine."""

from collections import deque
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from typing import Self

from probe_kit._system.child_process import Child
from probe_kit.errors import ProbeKitError, WorkerDiedError
from probe_kit.train.data.samples import Samples
from probe_kit.train.execution.executor import Probed, Problems, probe_column


class ProcessExecutor:
    """`size` processes; a task is its number. One that dies ends the sweep, which continues where it stopped."""

    def __init__(self, problems: Problems, size: int) -> None:
        self.size = size
        self._problems = problems
        self._submitted = 0
        self._ahead: deque[tuple[int, Samples]] = deque()
        self._at: dict[Connection, int | None] = {}
        self._found: dict[int, Probed | ProbeKitError] = {}

    def __enter__(self) -> Self:
        self._children = [Child("probe_kit.train.execution.processes:serve") for _ in range(self.size)]
        for child in self._children:
            child.connection.send(self._problems)
            self._at[child.connection] = None
        return self

    def __exit__(self, *_: object) -> None:
        for child in self._children:
            child.connection.close()  # all of them, so that they end side by side
        for child in self._children:
            child.close()

    def submit(self, samples: Samples) -> int:
        """A task that probes one column."""
        task, self._submitted = self._submitted, self._submitted + 1
        self._ahead.append((task, samples))
        self._hand_out()
        return task

    def _hand_out(self) -> None:
        for connection, busy in self._at.items():
            if busy is None and self._ahead:
                task, samples = self._ahead.popleft()
                self._at[connection] = task
                try:
                    connection.send(samples)
                except (BrokenPipeError, ConnectionResetError):
                    self._say_who_died(connection)

    def first_of(self, tasks: Sequence[int]) -> list[int]:
        """Wait until at least one task is done; those that are. Raises WorkerDiedError."""
        while not (done := [task for task in tasks if task in self._found]):
            for ready in wait([connection for connection, busy in self._at.items() if busy is not None]):
                self._hear(ready)
        return done

    def _hear(self, ready: object) -> None:
        assert isinstance(ready, Connection)
        task = self._at[ready]
        assert task is not None
        try:
            self._found[task] = ready.recv()
        except (EOFError, ConnectionResetError):
            self._say_who_died(ready)
        self._at[ready] = None
        self._hand_out()

    def _say_who_died(self, connection: Connection) -> None:
        (child,) = (child for child in self._children if child.connection is connection)
        raise WorkerDiedError(
            f"a probing process ended with code {child.close()}; look above for its last words. The same command "
            "continues after the last finished site; fewer --jobs take less memory"
        ) from None

    def result(self, task: int) -> Probed:
        """What a finished task found, or what went wrong in it."""
        found = self._found.pop(task)
        if isinstance(found, ProbeKitError):
            raise found
        return found


def serve(connection: Connection) -> None:
    """The child's side: one BLAS thread, and a column after the other until the parent hangs up."""
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    problems: Problems = connection.recv()
    with threadpool_limits(1):
        while True:
            samples: Samples = connection.recv()
            try:
                connection.send(probe_column(samples, problems))
            except ProbeKitError as error:
                connection.send(error)
