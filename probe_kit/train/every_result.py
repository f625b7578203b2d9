"""Readers of all probe results of a run, for its verification."""

from collections.abc import Callable, Iterator
from functools import partial

from probe_kit.runs.run import Run
from probe_kit.train.labels.label_store import is_of_label, load_label_results
from probe_kit.train.results.inventory import stored_probes
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import load_results, read_probes


def readers_of_results(run: Run) -> Iterator[Callable[[], object]]:
    """A function per stored result, which reads all of it. Raises RunDamagedError where they cannot be listed."""
    stored = read_probes(run.location)
    for key, bundle in stored.items():
        if is_of_label(bundle):
            yield partial(load_label_results, run, key)
        else:
            yield partial(_read, run, key)
    yield partial(stored_probes, run)


def _read(run: Run, key: str) -> object:
    results: ProbeResults = load_results(run, key)
    return results.scores, results.controls
