"""What executors share: settings, and the fit of one column."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from probe_kit.errors import ProbeKitError
from probe_kit.hooks.contract.sites import Site
from probe_kit.train.crossval.category_problem import CategoryProblem
from probe_kit.train.crossval.site_probe import SiteProbe
from probe_kit.train.data.samples import Samples

Key = tuple[str, Site]
"""A view and a site."""

Columns = Iterator[tuple[Key, Samples]]
Problems = Mapping[str, CategoryProblem]
Probed = dict[str, SiteProbe]


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


def probe_with_one_thread(samples: Samples, problems: Problems) -> Probed | ProbeKitError:
    """The probes of one column, with one BLAS thread; an error is returned, because Ray would wrap it."""
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    with threadpool_limits(1):
        try:
            return probe_column(samples, problems)
        except ProbeKitError as error:
            return error
