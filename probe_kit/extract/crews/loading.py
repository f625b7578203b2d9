"""A worker's first act, wherever it runs: load a model of its own and find the run."""

from probe_kit.extract.play.worker import Worker
from probe_kit.extract.prepared import load
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.store.locate import locate
from probe_kit.extract.store.writer import RunWriter


def load_worker(settings: ExtractSettings, run: str) -> Worker:
    """A worker for a run that exists, with a model of its own. Raises SettingsMismatchError if they differ."""
    prepared = load(settings)
    assert prepared.controller is not None
    writer = RunWriter(locate(run), prepared.plan, prepared.identity())
    return Worker(writer, settings, prepared.controller, len(writer.remaining()))
