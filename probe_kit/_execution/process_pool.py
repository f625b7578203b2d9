"""A pool of workers in child processes."""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from multiprocessing.connection import wait
from typing import Any, Self

from probe_kit._execution.child_process import Child
from probe_kit._execution.worker import Lost, Work
from probe_kit._system.machine import CORES, cores_here

VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"
LONGEST_WAIT_S = 1.0
"""A signal that arrives just before the system call does not end it: an endless wait would miss Ctrl-C."""


class ProcessPool:
    """Workers in processes, numbered from 0. A context manager.

    environment: by number, variables of the process beyond those of this one. exits: by exit code, the predicate
    of a sentence that says why a process ended.
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
        self._children[slot] = Child("probe_kit._execution.worker:serve", environment)

    def pid(self, slot: int) -> int:
        """The process id."""
        return self._children[slot].pid

    def send(self, slot: int, message: object) -> None:
        """Send a message; `receive` finds out if the process is dead."""
        with suppress(BrokenPipeError, ConnectionResetError):
            self._children[slot].connection.send(message)

    def receive(self) -> Iterator[tuple[int, Any]]:
        """Wait until a worker sends something; number and message of all that did, `Lost` of one that died."""
        connections = [child.connection for child in self._children.values()]
        while not (ready := wait(connections, LONGEST_WAIT_S)):
            pass
        for slot, child in self._children.copy().items():  # between two messages the executor may start others
            if child.connection not in ready:
                continue
            try:
                message = child.connection.recv()
            except (EOFError, ConnectionResetError):
                code = child.close()
                message = Lost(f"worker {slot}", self._exits.get(code, f"ended with code {code}"))
            yield slot, message


def share_of_machine(slot: int, size: int, device: str) -> dict[str, str]:
    """Variables of process number `slot` of `size`: a share of the cores, and one GPU where there are GPUs.

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
