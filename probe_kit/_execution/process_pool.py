"""A pool of child processes that run one service."""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any, Self

from probe_kit._execution.child_process import Child
from probe_kit.errors import ProbeKitError

LONGEST_WAIT_S = 1.0
"""A signal that arrives just before the system call does not end it: an endless wait would miss Ctrl-C."""


@dataclass(frozen=True)
class Ended:
    """What a pool receives from a process that died. code: its exit code."""

    code: int


class ProcessPool:
    """Processes of one service, numbered from 0. A context manager.

    service: `module:name`, see `Child`. setup: the first message to each. environment: by number, variables of the
    process beyond those of this one.
    """

    def __init__(
        self, service: str, setup: object, size: int, environment: Callable[[int], Mapping[str, str]] | None = None
    ) -> None:
        self._service, self._setup, self._size, self._environment = service, setup, size, environment
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

    def restart(self, slot: int) -> None:
        """Start process number `slot` again, which ended."""
        self._spawn(slot)
        self.send(slot, self._setup)

    def _spawn(self, slot: int) -> None:
        self._children[slot] = Child(self._service, self._environment and self._environment(slot))

    def pid(self, slot: int) -> int:
        """The process id."""
        return self._children[slot].pid

    def send(self, slot: int, message: object) -> None:
        """Send a message; `receive` finds out if the process is dead."""
        with suppress(BrokenPipeError, ConnectionResetError):
            self._children[slot].connection.send(message)

    def receive(self) -> Iterator[tuple[int, Any]]:
        """Wait until a process sends something; number and message of all that did, `Ended` of one that died.

        Raises the ProbeKitError that a process sends.
        """
        connections = [child.connection for child in self._children.values()]
        while not (ready := wait(connections, LONGEST_WAIT_S)):
            pass
        for slot, child in self._children.copy().items():
            if child.connection not in ready:
                continue
            try:
                message = child.connection.recv()
            except (EOFError, ConnectionResetError):
                message = Ended(child.close())
            if isinstance(message, ProbeKitError):
                raise message
            yield slot, message


def share_of_machine(slot: int, size: int, device: str) -> dict[str, str]:
    """Variables of process number `slot` of `size`: a share of the cores, and one GPU where there are GPUs."""
    share = {"OMP_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // size))}
    if device.startswith("cuda"):
        import torch

        share["CUDA_VISIBLE_DEVICES"] = str(slot % max(1, torch.cuda.device_count()))
    return share
