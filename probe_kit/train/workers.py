"""Probing many columns of features: in this process, in several, or on a Ray cluster."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, Protocol, Self

from probe_kit.hooks.sites import Site
from probe_kit.train.probe import SiteProbe
from probe_kit.train.problem import CategoryProblem
from probe_kit.train.samples import Samples

Key = tuple[str, Site]
"""A view and a site."""

Columns = Iterator[tuple[Key, Samples]]
Problems = Mapping[str, CategoryProblem]
Probed = dict[str, SiteProbe]


class Crew(Protocol):
    """Who probes columns side by side. A context manager; a task is whatever `submit` returns.

    size: columns that can be probed at once.
    """

    size: int

    def __enter__(self) -> Self:
        """Start the workers."""

    def __exit__(self, *_: object) -> None:
        """End them."""

    def submit(self, samples: Samples) -> Any:
        """A task that probes one column."""

    def first_of(self, tasks: Sequence[Any]) -> list[Any]:
        """Wait until at least one task is done; those that are."""

    def result(self, task: Any) -> Probed:
        """What a finished task found. Raises what went wrong in it."""


@dataclass(frozen=True)
class CrewSettings:
    """Who probes, which changes no number.

    jobs: columns at once, 1 by default. device: where torch solves them; numpy does without one. ray: address of
    a cluster that solves them, `auto` for the one this process belongs to or a new one on this machine; `jobs` is
    then by default as many as it has cores.
    """

    jobs: int | None = None
    device: str | None = None
    ray: str | None = None


def probe_columns(columns: Columns, problems: Problems, settings: CrewSettings) -> Iterator[tuple[Key, Probed]]:
    """The probes of every column by category, as they are done.

    Raises MissingExtraError if Ray is asked for and not installed, and what a worker raises.
    """
    jobs = settings.jobs or 1
    if settings.ray is not None:
        from probe_kit.train.ray_crew import RayCrew

        yield from _side_by_side(columns, RayCrew(problems, settings.ray, settings.jobs))
    elif jobs > 1:
        yield from _side_by_side(columns, ProcessCrew(problems, jobs))
    else:
        for key, samples in columns:
            yield key, probe_column(samples, problems, settings.device)


def _side_by_side(columns: Columns, crew: Crew) -> Iterator[tuple[Key, Probed]]:
    waiting: dict[Any, Key] = {}
    with crew:
        for key, samples in columns:
            waiting[crew.submit(samples)] = key
            if len(waiting) > crew.size:  # one column ahead, so that memory holds no more than that
                yield from _finished(crew, waiting)
        while waiting:
            yield from _finished(crew, waiting)


def _finished(crew: Crew, waiting: dict[Any, Key]) -> Iterator[tuple[Key, Probed]]:
    for task in crew.first_of(list(waiting)):
        yield waiting.pop(task), crew.result(task)


class ProcessCrew:
    """Processes on this machine."""

    def __init__(self, problems: Problems, size: int) -> None:
        self.size = size
        self._problems = problems

    def __enter__(self) -> Self:
        self._pool = ProcessPoolExecutor(self.size, get_context("spawn"), initializer=_prepare_worker)
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown()

    def submit(self, samples: Samples) -> Future[Probed]:
        """A task that probes one column."""
        return self._pool.submit(probe_column, samples, self._problems)

    def first_of(self, tasks: Sequence[Future[Probed]]) -> list[Future[Probed]]:
        """Wait until at least one task is done; those that are."""
        return list(wait(tasks, return_when=FIRST_COMPLETED).done)

    def result(self, task: Future[Probed]) -> Probed:
        """What a finished task found."""
        return task.result()


def probe_column(samples: Samples, problems: Problems, device: str | None = None) -> Probed:
    """The probes of one column by category."""
    there = samples.to(device)
    return {category: problem.probe(there) for category, problem in problems.items()}


def _prepare_worker() -> None:
    """One BLAS thread per process, and Ctrl-C left to the parent."""
    import signal

    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threadpool_limits(1)
