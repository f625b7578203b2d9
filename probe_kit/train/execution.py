"""Fits of many feature columns: in this process, in several, or on a Ray cluster."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from probe_kit._execution.executor import GivenUp, TaskQueue, work_off
from probe_kit._execution.process_pool import ProcessPool
from probe_kit._execution.ray_pool import RayPool
from probe_kit.errors import WorkerDiedError
from probe_kit.hooks.contract.sites import Site
from probe_kit.train.crossval.site_probe import SiteProbe
from probe_kit.train.data.samples import Samples
from probe_kit.train.problem import Problem

Key = tuple[str, Site]
"""A view and a site."""

Columns = Iterator[tuple[Key, Samples]]
Problems = Mapping[str, Problem]
Probed = dict[str, SiteProbe]


@dataclass(frozen=True)
class ExecutionSettings:
    """The workers that probe, which change no number.

    jobs: columns at once, 1 by default. device: where torch solves them; numpy does without one. ray: address of
    a cluster that solves them, `auto` for the one this process belongs to or a new one on this machine; `jobs` is
    then by default as many as it has cores.
    """

    jobs: int | None = None
    device: str | None = None
    ray: str | None = None


def probe_columns(
    columns: Columns, problems: Problems, settings: ExecutionSettings
) -> Iterator[tuple[Key, Probed]]:
    """The probes of every column by category, as they are done.

    Raises MissingExtraError if Ray is asked for and not installed, WorkerDiedError if workers die with the same
    column or before they begin, and what a worker raises.
    """
    jobs = settings.jobs or 1
    if settings.ray is None and jobs == 1:
        for key, samples in columns:
            yield key, _probe(samples, problems, settings.device)
        return
    pool = ProcessPool(fit_columns, problems, jobs) if settings.ray is None else RayPool(
        fit_columns, problems, settings.ray, lambda cluster: [0] * (settings.jobs or max(1, int(cluster["CPU"])))
    )  # fmt: skip
    # One column is read ahead, so that memory holds no more than that and those in work.
    queue = TaskQueue(((f"{key[1]} {key[0]}", (key, samples)) for key, samples in columns), "column")
    for slot, event in work_off(pool, queue):
        if isinstance(event, GivenUp):
            raise WorkerDiedError(
                f"the column {event.task[0][1]} {event.task[0][0]} was lost with each worker that fitted it; the "
                f"last one: {event.reason}. Its last words are above. The same command continues after the last "
                "finished site; fewer --jobs take less memory"
            )
        key, probed = event
        queue.end(slot, f"{key[1]} {key[0]}")
        yield key, probed


def fit_columns(
    problems: Problems, take: Callable[[], tuple[Key, Samples]], report: Callable[[tuple[Key, Probed]], None]
) -> None:
    """The work of a worker elsewhere: one column after the other, with one BLAS thread.

    With more threads each, the workers would wait for the same cores.
    """
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    with threadpool_limits(1):
        while True:
            key, samples = take()
            report((key, _probe(samples, problems)))


def _probe(samples: Samples, problems: Problems, device: str | None = None) -> Probed:
    on_device = samples.to(device)
    return {category: problem.probe(on_device) for category, problem in problems.items()}
