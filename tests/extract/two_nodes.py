"""Two Ray nodes on this machine, each with room for one worker; the second can be lost like a machine."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import psutil
import pytest

SHARED_MEMORY = 80 * 1024 * 1024
"""Bytes per node, the least that Ray takes: nothing but episode numbers travels."""


@dataclass(frozen=True)
class TwoNodes:
    """address: of the cluster, at its first node. second: the other, as Ray's `Cluster` knows it."""

    address: str
    second: Any

    @property
    def second_id(self) -> str:
        """Its name, as `ray list nodes` has it."""
        name: str = self.second.node_id
        return name

    def is_playing(self) -> bool:
        """Whether an actor of ours is on the second node. Ray puts its name into the process title."""
        return any("RayWorker" in " ".join(process.cmdline()) for process in self._tree()[1:])

    def lose_the_second(self) -> None:
        """SIGKILL for its raylet and everything that runs under it, the simulators of its actor included."""
        for process in self._tree():
            process.kill()

    def _tree(self) -> list[psutil.Process]:
        """The raylet first: an actor whose raylet lives is a worker that died, and no node that is lost."""
        (raylet,) = self.second.all_processes["raylet"]
        root = psutil.Process(raylet.process.pid)
        return [root, *root.children(recursive=True)]


@contextmanager
def two_nodes() -> Iterator[TwoNodes]:
    """Skips where Ray does not start. At its own niceness of 15, a busy machine would starve its workers."""
    ray = pytest.importorskip("ray", reason="Ray is not installed (extra `ray`)")
    from ray.cluster_utils import Cluster

    node: dict[str, Any] = {"num_cpus": 1, "object_store_memory": SHARED_MEMORY}
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("RAY_worker_niceness", "0")
            cluster = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
            second = cluster.add_node(**node)
        cluster.wait_for_nodes(timeout=180)
    except Exception as error:  # noqa: BLE001 - Ray raises a plain one where its own processes are too slow
        pytest.skip(f"Ray does not start two nodes here: {error}")
    try:
        yield TwoNodes(cluster.address, second)
    finally:
        ray.shutdown()
        cluster.shutdown()


def wait_for(what: Any, seconds: float = 400) -> None:
    """Until `what()` is true; the test fails if it never is."""
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline, "it never came to that"
        time.sleep(0.02)
