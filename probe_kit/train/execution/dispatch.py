"""Fits of many feature columns: in this process, in several, or on a Ray cluster."""

from collections.abc import Iterator

from probe_kit.train.execution.executor import (
    Columns,
    ExecutionSettings,
    Key,
    Probed,
    Problems,
    probe_column,
)
from probe_kit.train.execution.processes import ProcessExecutor
from probe_kit.train.execution.ray import RayExecutor


def probe_columns(
    columns: Columns, problems: Problems, settings: ExecutionSettings
) -> Iterator[tuple[Key, Probed]]:
    """The probes of every column by category, as they are done.

    Raises MissingExtraError if Ray is asked for and not installed, WorkerDiedError if a worker process dies, and
    what a worker raises.
    """
    jobs = settings.jobs or 1
    if settings.ray is not None:
        yield from _side_by_side(columns, RayExecutor(problems, settings.ray, settings.jobs))
    elif jobs > 1:
        yield from _side_by_side(columns, ProcessExecutor(problems, jobs))
    else:
        for key, samples in columns:
            yield key, probe_column(samples, problems, settings.device)


def _side_by_side(columns: Columns, executor: ProcessExecutor | RayExecutor) -> Iterator[tuple[Key, Probed]]:
    with executor:
        for key, samples in columns:
            executor.submit(key, samples)
            if executor.waiting > executor.size:  # one column ahead, so that memory holds no more than that
                yield from executor.finished()
        while executor.waiting:
            yield from executor.finished()
