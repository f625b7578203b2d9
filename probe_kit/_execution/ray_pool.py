"""A pool of workers on a Ray cluster (extra `ray`)."""

import os
import socket
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from queue import SimpleQueue
from typing import Any, Self

from probe_kit._execution.executor import Lost, Work, serve
from probe_kit._system.imports import require
from probe_kit.errors import UsageError

AUTO = "auto"
"""The cluster this process belongs to, or else a new one on this machine."""
KNOCK_TIMEOUT_S = 10.0
"""The time in which the head of a cluster has to accept a connection."""
PATIENCE_S = 300.0
"""The time without any worker before a warning."""
_THREADS = 3
"""The threads of an actor: one works, one takes tasks, one delivers reports."""


class ClusterFullWarning(UserWarning):
    """A warning that no node of the cluster has room for a worker; the work waits for one."""


class RayWorker:
    """An actor: a worker, and its side of the connection to the executor."""

    def __init__(self, setup: Any) -> None:
        self._tasks, self._reports = SimpleQueue[Any](), SimpleQueue[Any]()
        self._tasks.put(setup)
        self.recv, self.send = self._tasks.get, self._reports.put

    def work(self) -> None:
        """Work until the end of the process. An error that is not ours ends it, as in a child process."""
        try:
            serve(self)
        except BaseException:  # noqa: BLE001 - a worker that lives on in silence would be waited for for ever
            traceback.print_exc()
            os._exit(1)

    def give(self, task: Any) -> None:
        """Hand over a task."""
        self._tasks.put(task)

    def collect(self) -> tuple[str, list[Any]]:
        """Wait for reports; return the name of the node, as `ray list nodes` has it, and the reports."""
        reports = [self._reports.get()]
        while not self._reports.empty():
            reports.append(self._reports.get())
        return require("ray", "ray").get_runtime_context().get_node_id(), reports


class RayPool:
    """Workers as actors on the nodes of a cluster, numbered from 0. A context manager.

    Each holds a core and its GPUs, so that nodes share them. One without room begins later and delays no other.

    Args:
        work: The work of every worker.
        setup: The first argument of `work`; the cluster stores it once.
        address: The cluster's address; `AUTO` stands for the one this process belongs to, or a new one here.
        gpus: A function of the cluster's resources (`CPU`, `GPU`) that returns the GPUs of every worker.
    """

    def __init__(
        self, work: Work, setup: object, address: str, gpus: Callable[[Mapping[str, float]], Sequence[int]]
    ) -> None:
        self._setup, self._address, self._gpus_of = (work, setup), address, gpus
        self._actors: dict[int, Any] = {}
        self._collecting: dict[Any, int] = {}
        self._nodes: dict[int, str] = {}
        """The node of every worker that has begun."""
        self._alive_at_start: dict[int, set[str]] = {}
        """The nodes that were alive when a worker was started, by worker."""

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._ray = ray = stack.enter_context(ray_cluster(self._address))
            self._gpus = self._gpus_of(ray.cluster_resources())
            # Ray could restart an actor itself, but would fail every call meanwhile.
            options = {"num_cpus": 1, "max_restarts": 0, "max_task_retries": 0, "scheduling_strategy": "SPREAD"}
            self._kind = ray.remote(max_concurrency=_THREADS, **options)(RayWorker)
            self._content = ray.put(self._setup)  # once, not with every worker
            for slot in range(len(self._gpus)):
                self.start(slot)
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        with self._opened:
            for actor in self._actors.values():
                self._ray.kill(actor)

    @property
    def slots(self) -> set[int]:
        """The numbers of the workers."""
        return set(self._actors)

    def start(self, slot: int) -> None:
        """Start worker number `slot`, again if it was lost."""
        self._alive_at_start[slot] = self._alive()
        actor = self._actors[slot] = self._kind.options(num_gpus=self._gpus[slot]).remote(self._content)
        actor.work.remote()
        self._collecting[actor.collect.remote()] = slot

    def stop(self, slot: int) -> None:
        """End an idle worker, which makes room for others."""
        # Its pending call would end as that of a lost worker.
        self._collecting = {call: other for call, other in self._collecting.items() if other != slot}
        self._ray.kill(self._actors.pop(slot))

    def send(self, slot: int, message: object) -> None:
        """Send a task; `receive` finds out if the worker is dead."""
        self._actors[slot].give.remote(message)

    def receive(self) -> Iterator[tuple[int, Any]]:
        """Wait until a worker reports; yield number and message of all that it sent, `Lost` of one that died."""
        call = self._next_answer()
        slot = self._collecting.pop(call)
        try:
            self._nodes[slot], reports = self._ray.get(call)
        except (self._ray.exceptions.RayActorError, self._ray.exceptions.ObjectLostError) as error:
            yield slot, self._lose_task(slot, error)
            return
        self._collecting[self._actors[slot].collect.remote()] = slot
        for report in reports:
            yield slot, report

    def _next_answer(self) -> Any:
        """Return the next finished call; warn at intervals of `PATIENCE_S` as long as no worker has begun."""
        while True:
            ready, _ = self._ray.wait(list(self._collecting), num_returns=1, timeout=PATIENCE_S)
            if ready:
                return ready[0]
            if not self._nodes:
                free = {name: self._ray.available_resources().get(name, 0) for name in ("CPU", "GPU")}
                warnings.warn(
                    f"no worker on the Ray cluster has begun within {PATIENCE_S:.0f} s: each needs a core"
                    f"{' and a GPU' if any(self._gpus) else ''}, and the cluster has {free['CPU']:g} cores and "
                    f"{free['GPU']:g} GPUs free. It still loads, or waits for a node: `ray status` shows which",
                    ClusterFullWarning,
                    stacklevel=2,
                )

    def _lose_task(self, slot: int, error: Exception) -> Lost:
        self._ray.kill(self._actors[slot])  # it may live on behind a broken network
        node = self._nodes.pop(slot, None)
        where = "of the Ray cluster that had not begun" if node is None else f"on node {node} of the Ray cluster"
        why = " ".join(line for line in str(error).splitlines() if not line.startswith("\t"))  # but Ray's numbers
        # Until Ray knows of a lost node it puts workers there that never run, as many as were lost with it.
        return Lost(f"a worker {where}", f"is lost: {why}", counts=self._alive_at_start[slot] <= self._alive())

    def _alive(self) -> set[str]:
        return {node["NodeID"] for node in self._ray.nodes() if node["Alive"]}


@contextmanager
def ray_cluster(address: str) -> Iterator[Any]:
    """Yield the module `ray`, connected to the cluster at `address` while the body runs.

    A connection that was there before stays. This process prints what workers print.

    Raises:
        MissingExtraError: Without Ray.
        UsageError: If nothing answers at the address.
    """
    ray = require("ray", "ray")
    if ray.is_initialized():
        yield ray
        return
    try:
        _knock(address)
        ray.init(address=None if address == AUTO else address, include_dashboard=False)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"no Ray cluster answers at {address!r}: {error}. Start one with `ray start --head`, or give "
            f"{AUTO!r} for a new one on this machine"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _knock(address: str) -> None:
    """Raise OSError if no server answers: Ray itself tries a dead address for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=KNOCK_TIMEOUT_S).close()
