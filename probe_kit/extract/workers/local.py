"""A worker in this process, with the model that is already loaded."""

from collections.abc import Callable

from probe_kit.extract.plan import RowPlan
from probe_kit.extract.prepared import Prepared
from probe_kit.extract.rollout.events import Event
from probe_kit.extract.rollout.worker import Worker
from probe_kit.extract.workers.scheduler import Scheduler
from probe_kit.runs.writer import RunWriter


def run_here(
    prepared: Prepared, writer: RunWriter[RowPlan], scheduler: Scheduler, on_event: Callable[[Event], None]
) -> None:
    """Play every episode in this process, with the model that is loaded."""
    assert prepared.controller is not None
    episodes = len(writer.remaining())
    with Worker(writer, prepared.settings, prepared.controller, episodes) as worker:
        while not scheduler.finished:
            for event in worker.run(lambda: scheduler.take(0)):
                scheduler.record(0, event)
                on_event(event)
