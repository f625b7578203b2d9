"""Probe fits in processes on this machine."""

from collections import deque
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Self

from probe_kit._execution.process_pool import Ended, ProcessPool
from probe_kit.errors import WorkerDiedError
from probe_kit.train.data.samples import Samples
from probe_kit.train.execution.executor import Key, Probed, Problems, probe_with_one_thread


class ProcessExecutor:
    """`size` processes. One that dies ends the sweep, which continues where it stopped."""

    def __init__(self, problems: Problems, size: int) -> None:
        self.size = size
        self.pool = ProcessPool("probe_kit.train.execution.processes:serve", problems, size)
        self._ahead: deque[tuple[Key, Samples]] = deque()
        self._busy: dict[int, Key] = {}

    def __enter__(self) -> Self:
        self.pool.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self.pool.__exit__(*error)

    @property
    def waiting(self) -> int:
        """Columns that were submitted and are not finished."""
        return len(self._ahead) + len(self._busy)

    def submit(self, key: Key, samples: Samples) -> None:
        """Fit one column as soon as a process is idle."""
        self._ahead.append((key, samples))
        self._hand_out()

    def _hand_out(self) -> None:
        for slot in range(self.size):
            if slot not in self._busy and self._ahead:
                self._busy[slot], samples = self._ahead.popleft()
                self.pool.send(slot, samples)

    def finished(self) -> Iterator[tuple[Key, Probed]]:
        """Wait until at least one column is done; those that are. Raises WorkerDiedError and what a fit raises."""
        for slot, message in self.pool.receive():
            if isinstance(message, Ended):
                raise WorkerDiedError(
                    f"a probing process ended with code {message.code}; look above for its last words. The same "
                    "command continues after the last finished site; fewer --jobs take less memory"
                )
            key = self._busy.pop(slot)
            self._hand_out()
            yield key, message


def serve(connection: Connection) -> None:
    """The child's side: a column after the other until the parent hangs up."""
    problems: Problems = connection.recv()
    while True:
        connection.send(probe_with_one_thread(connection.recv(), problems))
