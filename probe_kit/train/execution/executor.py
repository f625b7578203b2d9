"""Base class of the executors that fit columns in parallel."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

from probe_kit.hooks.contract.sites import Site
from probe_kit.train.crossval.category_problem import CategoryProblem
from probe_kit.train.crossval.site_probe import SiteProbe
from probe_kit.train.data.samples import Samples

Key = tuple[str, Site]
"""A view and a site."""

Columns = Iterator[tuple[Key, Samples]]
Problems = Mapping[str, CategoryProblem]
Probed = dict[str, SiteProbe]


class ProbeExecutor(Protocol):
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
class ExecutionSettings:
    """Who probes, which changes no number.

    jobs: columns at once, 1 by default. device: where torch solves them; numpy does without one. ray: address of
    a cluster that solves them, `auto` for the one this process belongs to or a new one on this machine; `jobs` is
    then by default as many as it has cores.
    """

    jobs: int | None = None
    device: str | None = None
    ray: str | None = None


def probe_column(samples: Samples, problems: Problems, device: str | None = None) -> Probed:
    """The probes of one column by category."""
    there = samples.to(device)
    return {category: problem.probe(there) for category, problem in problems.items()}
