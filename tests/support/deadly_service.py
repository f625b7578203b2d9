"""Services of a process that plays models, and ends with code 7 where a test wants that."""

import sys
from multiprocessing.connection import Connection
from typing import Any

from probe_kit.study.running import processes
from probe_kit.study.running.model_task import ModelTask


class _Wary:
    """A connection that ends the process once it has received the model `first`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def send(self, message: object) -> None:
        self._connection.send(message)

    def recv(self) -> Any:
        message = self._connection.recv()
        if isinstance(message, ModelTask) and message.model == "first":
            sys.exit(7)
        return message


def serve(connection: Connection) -> None:
    """As `processes.serve`, but for one model."""
    processes.serve(_Wary(connection))  # type: ignore[arg-type]


def stillborn(_: Connection) -> None:
    """Ends at once."""
    sys.exit(7)
