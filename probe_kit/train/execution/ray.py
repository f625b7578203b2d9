"""Probe fits on a Ray cluster."""

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any, Self

from probe_kit._execution.ray_cluster import answer_of, ray_cluster
from probe_kit.errors import WorkerDiedError
from probe_kit.train.data.samples import Samples
from probe_kit.train.execution.executor import Key, Probed, Problems, probe_with_one_thread


class RayExecutor:
    """Tasks on a cluster, one core each; a task whose worker dies is repeated by Ray.

    address: of the cluster, whose nodes have probe_kit installed; `auto` for the one this process belongs to, or
    else a new one on this machine. size: columns at once, by default as many as the cluster has cores.
    Raises MissingExtraError without Ray, and UsageError if nothing answers at the address.
    """

    def __init__(self, problems: Problems, address: str, size: int | None = None) -> None:
        self._problems, self._address = problems, address
        self._size = size
        self._tasks: dict[Any, Key] = {}

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._ray = ray = stack.enter_context(ray_cluster(self._address, log_to_driver=False))
            self.size = self._size or max(1, int(ray.cluster_resources().get("CPU", 1)))
            self._probe = ray.remote(num_cpus=1)(probe_with_one_thread)
            self._shared = ray.put(self._problems)  # once, not with every column
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    @property
    def waiting(self) -> int:
        """Columns that were submitted and are not finished."""
        return len(self._tasks)

    def submit(self, key: Key, samples: Samples) -> None:
        """A task that fits one column."""
        self._tasks[self._probe.remote(samples, self._shared)] = key

    def finished(self) -> Iterator[tuple[Key, Probed]]:
        """Wait until at least one task is done; its column. Raises what a fit raises.

        Raises WorkerDiedError for a task that Ray has repeated in vain.
        """
        broken = self._ray.exceptions
        lost = broken.WorkerCrashedError, broken.OutOfMemoryError, broken.NodeDiedError, broken.ObjectLostError
        ready, _ = self._ray.wait(list(self._tasks), num_returns=1)
        for task in ready:
            try:
                probed: Probed = answer_of(self._ray, task)
            except lost as error:
                raise WorkerDiedError(
                    f"a probing task on the Ray cluster was lost again and again; the last time: {error}. The "
                    "same command continues after the last finished site; fewer --jobs take less memory of a node"
                ) from error
            yield self._tasks.pop(task), probed
