"""A worker's first act, wherever it runs: load a model of its own and find the run."""

from probe_kit.extract.play.worker import Worker
from probe_kit.extract.prepared import load
from probe_kit.extract.settings import RunSettings
from probe_kit.extract.store.locate import locate


def load_worker(settings: RunSettings, run: str) -> Worker:
    """A worker for a run that exists, with a model of its own.

    Raises SettingsMismatchError if they differ, or if this machine gives other numbers than those before it.
    """
    prepared = load(settings, rehearsed=True)
    assert prepared.controller is not None
    writer = prepared.writer(locate(run))
    writer.begin(settings.allow_mixed)
    return Worker(writer, prepared.settings, prepared.controller, len(writer.remaining()))
