"""Readers of all probe results of a run, for its verification."""

from collections.abc import Callable, Iterator
from functools import partial

from probe_kit.runs.run import Run
from probe_kit.train.results.inventory import stored_probes
from probe_kit.train.results.store import load_results, read_probes


def readers_of_results(run: Run) -> Iterator[Callable[[], object]]:
    """Yield a function per stored result, which reads all of it. Raises RunDamagedError for damaged ones."""
    for key in read_probes(run.location):
        yield partial(_read, run, key)
    yield partial(stored_probes, run)


def _read(run: Run, key: str) -> object:
    results = load_results(run, key)
    return results.scores, results.controls
