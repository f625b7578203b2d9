"""A child process that answers requests over one connection, and a pool of workers in such processes.

`multiprocessing` starts a child by importing the caller's script again. That breaks every script and notebook
without a main guard. Forking breaks torch and zarr. So a child is a fresh interpreter that runs this module and
exchanges messages with its parent through a socket. It lives in its own session, so that Ctrl-C reaches the parent
alone. It ends when the parent closes the socket or dies.
"""

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection, wait
from typing import Any, Self

from probe_kit._execution.array_connection import ArrayConnection, open_shared_memory
from probe_kit._execution.executor import Lost, Work
from probe_kit._system.machine import CORES, cores_here

GRACE_S = 10.0
"""The time in which a child ends after its parent hung up."""


class Child:
    """A child running `service`, a function `module:name` that takes the child's end of the connection.

    Its variables are those of this process; `environment` adds to them or replaces them.
    """

    def __init__(self, service: str, environment: Mapping[str, str] | None = None) -> None:
        ours, theirs = socket.socketpair()
        memory = open_shared_memory()
        with theirs:
            descriptors = theirs.fileno(), memory
            # The child imports from wherever this process does, also where a script or notebook changed it.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "probe_kit._execution.process_pool", service, *map(str, descriptors)],
                pass_fds=descriptors,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **(environment or {})},
                start_new_session=True,
            )
        self.connection = ArrayConnection(Connection(ours.detach()), memory, is_child=False)

    @property
    def pid(self) -> int:
        """The process id of the child."""
        return self._process.pid

    def close(self) -> int:
        """Hang up, wait for the end of the child, which is killed if it does not end, and return its exit code."""
        self.connection.close()
        try:
            return self._process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


def main() -> None:
    """Serve the connection whose file descriptor is the second argument; that of its memory is the third."""
    module, name = sys.argv[1].split(":")
    service: Callable[[ArrayConnection], None] = getattr(import_module(module), name)
    with ArrayConnection(Connection(int(sys.argv[2])), int(sys.argv[3]), is_child=True) as connection:
        try:
            service(connection)
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return  # the parent hung up or is gone


# -- the pool -------------------------------------------------------------------------------------------------

VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"
LONGEST_WAIT_S = 1.0
"""The longest wait for a message.

A signal that arrives just before the system call does not end it: an endless wait would miss Ctrl-C.
"""


class ProcessPool:
    """Workers in processes, numbered from 0. A context manager.

    Args:
        work: The work of every worker.
        setup: The first argument of `work`, which is sent to every process.
        size: The number of processes.
        environment: Variables of a process beyond those of this one, by its number. None: no others.
        exits: The predicate of a sentence that says why a process ended, by exit code. A code without one is
            named.
    """

    def __init__(
        self, work: Work, setup: object, size: int,
        environment: Callable[[int], Mapping[str, str]] | None = None, exits: Mapping[int, str] | None = None,
    ) -> None:  # fmt: skip
        self._setup, self._size, self._environment, self._exits = (work, setup), size, environment, exits or {}
        self._children: dict[int, Child] = {}

    def __enter__(self) -> Self:
        for slot in range(self._size):
            self._spawn(slot)
        for slot in range(self._size):  # when all are starting: a setup of some size waits for its reader
            self.send(slot, self._setup)
        return self

    def __exit__(self, *_: object) -> None:
        for child in self._children.values():
            child.connection.close()  # all of them, so that they end side by side
        for child in self._children.values():
            child.close()

    @property
    def slots(self) -> set[int]:
        """The numbers of the workers."""
        return set(self._children)

    def start(self, slot: int) -> None:
        """Start worker number `slot` again, which ended."""
        self._spawn(slot)
        self.send(slot, self._setup)

    def stop(self, slot: int) -> None:
        """End an idle worker."""
        self._children.pop(slot).close()

    def _spawn(self, slot: int) -> None:
        environment = self._environment and self._environment(slot)
        self._children[slot] = Child("probe_kit._execution.executor:serve", environment)

    def pid(self, slot: int) -> int:
        """Return the process id of a worker."""
        return self._children[slot].pid

    def send(self, slot: int, message: object) -> None:
        """Send a message; `receive` finds out if the process is dead."""
        with suppress(BrokenPipeError, ConnectionResetError):
            self._children[slot].connection.send(message)

    def receive(self) -> Iterator[tuple[int, Any]]:
        """Wait until workers send something; yield number and message of each, and `Lost` for one that died."""
        # Between two messages the executor may start others.
        waiting = {child.connection.fileno(): (slot, child) for slot, child in self._children.items()}
        while not (ready := wait(waiting, LONGEST_WAIT_S)):
            pass
        for descriptor, (slot, child) in waiting.items():
            if descriptor not in ready:
                continue
            try:
                message = child.connection.recv()
            except (EOFError, ConnectionResetError):
                code = child.close()
                message = Lost(f"worker {slot}", self._exits.get(code, f"ended with code {code}"))
            yield slot, message


def share_of_machine(slot: int, size: int, device: str) -> dict[str, str]:
    """Return the variables of process number `slot` of `size`: a share of the cores, and a GPU if `device` is one.

    It is a share of what this process itself has: a worker of a pool that opens a pool divides its own share.
    """
    cores = str(max(1, cores_here() // size))
    share = {"OMP_NUM_THREADS": cores, CORES: cores}
    if device.startswith("cuda"):
        import torch

        visible = os.environ.get(VISIBLE_GPUS)
        # Numbers of torch count the visible GPUs, those of the variable all of them.
        gpus = visible.split(",") if visible else [str(gpu) for gpu in range(max(1, torch.cuda.device_count()))]
        share[VISIBLE_GPUS] = gpus[slot % len(gpus)]
    return share


if __name__ == "__main__":
    main()
