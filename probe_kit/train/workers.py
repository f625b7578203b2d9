"""Probing many columns of features, in this process or in several."""

from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context

from probe_kit.hooks.sites import Site
from probe_kit.train.probe import SiteProbe
from probe_kit.train.problem import CategoryProblem
from probe_kit.train.samples import Samples

Key = tuple[str, Site]
"""A view and a site."""

Columns = Iterator[tuple[Key, Samples]]
Problems = Mapping[str, CategoryProblem]
Probed = dict[str, SiteProbe]


def probe_columns(
    columns: Columns, problems: Problems, jobs: int, device: str | None = None
) -> Iterator[tuple[Key, Probed]]:
    """The probes of every column by category, as they are done; `jobs` processes, or this one if 1.

    device: where torch solves them; numpy does without one.
    """
    if jobs > 1:
        yield from _in_processes(columns, problems, jobs, device)
        return
    for key, samples in columns:
        yield key, _probe_column(samples, problems, device)


def _in_processes(
    columns: Columns, problems: Problems, jobs: int, device: str | None
) -> Iterator[tuple[Key, Probed]]:
    waiting: dict[Future[Probed], Key] = {}
    with ProcessPoolExecutor(jobs, get_context("spawn"), initializer=_prepare_worker) as pool:
        for key, samples in columns:
            waiting[pool.submit(_probe_column, samples, problems, device)] = key
            if len(waiting) > jobs:  # one column ahead, so that memory holds no more than that
                yield from _finished(waiting)
        while waiting:
            yield from _finished(waiting)


def _finished(waiting: dict[Future[Probed], Key]) -> Iterator[tuple[Key, Probed]]:
    for task in wait(waiting, return_when=FIRST_COMPLETED).done:
        yield waiting.pop(task), task.result()


def _probe_column(samples: Samples, problems: Problems, device: str | None) -> Probed:
    there = samples.to(device)
    return {category: problem.probe(there) for category, problem in problems.items()}


def _prepare_worker() -> None:
    """One BLAS thread per process, and Ctrl-C left to the parent."""
    import signal

    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threadpool_limits(1)
