"""Probe fits on a Ray cluster."""

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any, Self

from probe_kit._system.cluster import ray_cluster
from probe_kit.errors import ProbeKitError, WorkerDiedError
from probe_kit.train.data.samples import Samples
from probe_kit.train.execution.executor import Probed, Problems, probe_column


class RayExecutor:
    """Tasks on a cluster, one core each; a task whose worker dies is repeated by Ray.

    address: of the cluster, whose nodes have probe_kit installed; `auto` for the one this process belongs to, or
    else a new one on this machine. size: columns at once, by default as many as the cluster has cores.
    Raises MissingExtraError without Ray, and UsageError if nothing answers at the address.
    """

    def __init__(self, problems: Problems, address: str, size: int | None = None) -> None:
        self._problems, self._address = problems, address
        self._size = size

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._ray = ray = stack.enter_context(ray_cluster(self._address, log_to_driver=False))
            self.size = self._size or max(1, int(ray.cluster_resources().get("CPU", 1)))
            self._probe = ray.remote(num_cpus=1)(_probe_alone)
            self._shared = ray.put(self._problems)  # once, not with every column
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def submit(self, samples: Samples) -> Any:
        """A task that probes one column."""
        return self._probe.remote(samples, self._shared)

    def first_of(self, tasks: Sequence[Any]) -> list[Any]:
        """Wait until at least one task is done; those that are."""
        ready, _ = self._ray.wait(list(tasks), num_returns=1)
        return list(ready)

    def result(self, task: Any) -> Probed:
        """What a finished task found. Raises WorkerDiedError for one that Ray has repeated in vain."""
        broken = self._ray.exceptions
        lost = broken.WorkerCrashedError, broken.OutOfMemoryError, broken.NodeDiedError, broken.ObjectLostError
        try:
            found: Probed | ProbeKitError = self._ray.get(task)
        except lost as error:
            raise WorkerDiedError(
                f"a probing task on the Ray cluster was lost again and again; the last time: {error}. The same "
                "command continues after the last finished site; fewer --jobs take less memory of a node"
            ) from error
        if isinstance(found, ProbeKitError):
            raise found
        return found


def _probe_alone(samples: Samples, problems: Problems) -> Probed | ProbeKitError:
    """One BLAS thread, as the task was given one core. What goes wrong is an answer: Ray would wrap it."""
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    with threadpool_limits(1):
        try:
            return probe_column(samples, problems)
        except ProbeKitError as error:
            return error
