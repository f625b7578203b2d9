"""The queue of models: which is played next, and what is left of one whose process was lost."""

import warnings
from collections import Counter
from collections.abc import Iterable

from probe_kit.extract.workers.worker_errors import WorkerLostWarning
from probe_kit.study.ledger import Failure, now
from probe_kit.study.running.model_task import Event, Made, ModelTask, Moved

MOST_LOSSES = 3
"""Processes of a model that may be lost one after another without an episode in between."""


class TaskQueue:
    """Models that are to be played, the longest first. A place is whatever plays one model at a time."""

    def __init__(self, tasks: Iterable[ModelTask]) -> None:
        self._waiting = sorted(tasks, key=lambda task: -task.size)
        self._held: dict[int, ModelTask] = {}
        self._losses: Counter[str] = Counter()

    @property
    def finished(self) -> bool:
        """Whether nothing is left to play or in play."""
        return not (self._waiting or self._held)

    def take(self, place: int, has_gpu: bool = True) -> ModelTask | None:
        """The next model for a place; None if there is none that it can play."""
        fitting = [task for task in self._waiting if has_gpu or not task.gpus]
        if not fitting:
            return None
        self._waiting.remove(fitting[0])
        self._held[place] = fitting[0]
        return fitting[0]

    def holds(self, place: int) -> ModelTask | None:
        """What a place has in play."""
        return self._held.get(place)

    def note(self, place: int, event: Event) -> None:
        """Note an event of a place: what is made or given up is not played again there or elsewhere."""
        if isinstance(event, Moved):
            self._losses[event.model] = 0
        elif place in self._held and (isinstance(event, Made) or event.stage == "episodes"):
            self._held[place] = self._held[place].without([event.run])

    def end(self, place: int) -> None:
        """Note that a place is done with its model."""
        self._held.pop(place, None)

    def lose(self, place: int, why: str, counts: bool = True) -> Failure | None:
        """Note that a place was lost: its model waits again, or is given up.

        why: what became of the place. counts: False for a loss that is no sign against the model, such as that of
        a whole node.
        """
        task = self._held.pop(place, None)
        if task is None or not task.runs:
            return None
        self._losses[task.model] += counts
        if self._losses[task.model] < MOST_LOSSES:
            self._waiting.insert(0, task)
            return None
        reason = f"{why}, {MOST_LOSSES} times without an episode in between. Its last words are above"
        run, error = task.runs[0].run, "WorkerDiedError"
        return Failure(stage="playing", model=task.model, run=run, reason=reason, error=error, when=now())


def warn_of_loss(what: str) -> None:
    """Warn that a process or node is gone."""
    warnings.warn(f"{what}; what it had not stored is played again", WorkerLostWarning, stacklevel=2)
