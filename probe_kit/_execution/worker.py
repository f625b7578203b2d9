"""The side of a worker: it takes one task after the other and reports events, wherever it runs."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from probe_kit.errors import ProbeKitError

Work = Callable[[Any, Callable[[], Any], Callable[[Any], None]], None]
"""The work of a worker, a function of a module: (setup, take, report).

setup: as the executor was given it. take: waits for the next task; None if a worker that still works on a task
should finish it first. report: sends an event. The function never returns; it ends with its process.
"""


class Connection(Protocol):
    """A pipe to the executor."""

    def send(self, message: Any, /) -> None:
        """Send a message."""

    def recv(self) -> Any:
        """Wait for a message."""


@dataclass(frozen=True)
class Idle:
    """The message of a worker that waits for a task."""


@dataclass(frozen=True)
class Lost:
    """The message of a pool about a worker that is gone.

    worker: the worker, as a sentence names it. why: the predicate of that sentence. counts: False for a loss that
    is no sign against the tasks of the worker, such as that of a whole node.
    """

    worker: str
    why: str
    counts: bool = True

    def __str__(self) -> str:
        return f"{self.worker} {self.why}"


def serve(connection: Connection) -> None:
    """Do the work that the first message names; an error of ours is sent as a message."""
    work, setup = connection.recv()

    def take() -> Any:
        connection.send(Idle())
        return connection.recv()

    try:
        work(setup, take, connection.send)
    except ProbeKitError as error:
        connection.send(error)
