"""Child processes that answer requests over one connection.

`multiprocessing` starts a child by importing the caller's script again, which breaks every script and notebook
without a main guard; forking breaks torch and zarr. So a child is a fresh interpreter that runs this module and
talks to its parent through a socket. It lives in its own session, so that Ctrl-C reaches the parent alone, and
ends when the parent closes the socket or dies.
"""

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from multiprocessing.connection import Connection

GRACE_S = 10.0
"""Time in which a child ends after its parent hung up."""


class Child:
    """A child running `service`, a function `module:name` that takes the child's end of the connection."""

    def __init__(self, service: str, environment: Mapping[str, str] | None = None) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            # The child imports from wherever this process does, also where a script or notebook changed it.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "probe_kit._execution.child_process", service, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **(environment or {})},
                start_new_session=True,
            )
        self.connection = Connection(ours.detach())

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    def close(self) -> int:
        """Hang up and wait for the end; a child that does not end is killed. Returns its exit code."""
        self.connection.close()
        try:
            return self._process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


def main() -> None:
    """Serve the connection whose file descriptor is the second argument."""
    module, name = sys.argv[1].split(":")
    service: Callable[[Connection], None] = getattr(import_module(module), name)
    with Connection(int(sys.argv[2])) as connection:
        try:
            service(connection)
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return  # the parent hung up or is gone


if __name__ == "__main__":
    main()
