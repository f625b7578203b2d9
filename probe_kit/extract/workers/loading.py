"""Start of a worker: loads its own model and opens the run."""

from collections.abc import Iterator
from contextlib import contextmanager

from probe_kit.extract.prepared import load
from probe_kit.extract.rollout.worker import Worker
from probe_kit.extract.settings import Settings
from probe_kit.runs.store import locate


@contextmanager
def load_worker(settings: Settings, run: str) -> Iterator[Worker]:
    """A worker for a run that exists, with a model of its own; the run is held while the body runs.

    Raises SettingsMismatchError if they differ, or if this machine gives other numbers than those before it.
    """
    prepared = load(settings, rehearsed=True)
    assert prepared.controller is not None
    writer = prepared.writer(locate(run))
    with writer.joined():
        writer.begin(settings.machine.allow_mixed)
        episodes = len(writer.remaining())
        with Worker(writer, prepared.settings, prepared.controller, episodes) as worker:
            yield worker
