"""Playing of all runs that a plan finds missing, in this process, in several, or on a Ray cluster."""

from collections.abc import Iterator
from pathlib import Path

from probe_kit._system.optional_dependencies import require
from probe_kit.env import SceneSpec
from probe_kit.errors import ProbeKitError
from probe_kit.extract.preparation import open_checked
from probe_kit.runs import open_run, seal
from probe_kit.runs.store import locate
from probe_kit.study.ledger import NOT_TRIED_AGAIN, Failure, Ledger
from probe_kit.study.planning.cost import units
from probe_kit.study.planning.plan import PlannedCell, StudyPlan, cells_by_model, given_up
from probe_kit.study.running.model_task import STOPS_ALL, Event, Made, ModelTask, Report, RunTask, played_by
from probe_kit.study.running.playing import play_models


def conduct_study(
    plan: StudyPlan,
    report: Report | None = None,
    *,
    slots: int = 0,
    ray: str | None = None,
    env_workers: int | None = None,
    retry_failed: bool = False,
) -> list[Failure]:
    """Play and ask all that a plan finds missing; returns what failed, now or before.

    Every run is checked, and every scene built, before the first one is played. A model that fails stops itself
    alone: episodes that are committed stay, and the next call resumes after them. What failed while it was played
    is not tried again until its settings change, or with `retry_failed`. The ledger notes all of it.
    report: called with every event as it happens. slots: processes, each with one model at a time; 0 for this
    process. ray: address of a Ray cluster that plays instead, or `auto`. env_workers: processes that simulate, as
    in `ExtractSettings`.
    Raises DiskSpaceError and StoreError, MissingExtraError without Ray, and UsageError if no cluster answers.
    """
    if ray is not None:
        require("ray", "ray")
    course = _Course(plan, report, ray, env_workers)
    missing = [one for one in plan.played if one.state != "whole"]
    if not retry_failed:
        course.failures += [one.failure for one in missing if one.failure and one.failure.stage in NOT_TRIED_AGAIN]
        missing = [one for one in missing if not given_up(one)]
    with course.ledger.opened():
        pass  # a place that cannot be written is no model's failure
    tasks = list(course.checked(missing))
    if tasks:
        play_models(tasks, course.note, slots, ray)
    course.note_found()
    return course.failures


class _Course:
    """What happens while a plan is played. failures: so far."""

    def __init__(self, plan: StudyPlan, report: Report | None, ray: str | None, env_workers: int | None) -> None:
        self._plan, self._report, self._ray, self._env_workers = plan, report, ray, env_workers
        self._cells = {one.cell.name: one.cell for one in plan.cells}
        self.ledger = Ledger(plan.study.study.folder)
        self.failures: list[Failure] = []

    def note(self, event: Event) -> None:
        """Write to the ledger what is made and what failed, and report it."""
        if isinstance(event, Made):
            self.ledger.note(self._cells[event.run], played=event.played, failure=None)
        elif isinstance(event, Failure):
            self.failures.append(event)
            if not event.same(self.ledger.of(self._cells[event.run]).failure):
                self.ledger.note(self._cells[event.run], failure=event)
        if self._report is not None:
            self._report(event)

    def note_found(self) -> None:
        """Finish and enter runs that are whole and not noted: made by hand, or by a process that was killed."""
        for one in self._plan.played:
            if one.state == "whole" and not one.noted:
                location = locate(one.location)
                with location.held(lambda: None):  # which removes what a killed process left aside
                    seal(location)
                self.ledger.note(one.cell, played=played_by(open_run(location, allow_partial=True)), failure=None)

    def checked(self, missing: list[PlannedCell]) -> Iterator[ModelTask]:
        """The tasks of all models whose runs pass the checks; the others fail at once."""
        rehearsed: list[SceneSpec] = []
        for model, cells in cells_by_model(missing).items():
            failure = next(filter(None, (self._problem(one, rehearsed) for one in cells)), None)
            if failure is not None:
                self.note(failure)
                continue
            study = self._plan.study.study
            reuse = tuple(str(Path(folder).resolve()) for folder in study.reuse.folders)
            size = sum(map(self._size, cells))
            yield ModelTask(model, tuple(map(self._task, cells)), study.models[model].gpus, size, reuse)

    def _size(self, one: PlannedCell) -> float:
        """Seconds; where no rate is known, a tenth of one per inference."""
        return self._plan.cost.seconds.get(one.cell.name, 0.1 * one.missing * units(one.cell))

    def _problem(self, one: PlannedCell, rehearsed: list[SceneSpec]) -> Failure | None:
        """What is wrong with a run as far as it shows without the model. rehearsed: scenes that can be built."""
        try:
            if one.state == "damaged":
                raise ProbeKitError(one.why.removeprefix("damaged: "))
            chosen = one.cell.settings_to_play.changed(ray=self._ray)  # its devices are elsewhere
            settings, source = open_checked(chosen, locate(one.location))
            if settings.scene not in rehearsed:
                source.rehearse(source.rows(settings.seed))
                rehearsed.append(settings.scene)
        except STOPS_ALL:
            raise
        except ProbeKitError as error:
            return Failure.of("checking", one.cell.model, one.cell.name, error)
        return None

    def _task(self, one: PlannedCell) -> RunTask:
        settings = one.cell.settings_to_play
        folder = one.cell.suite.folder
        suite = None if folder is None else folder.resolve()
        settings = settings.changed(suite=suite, env_workers=self._env_workers)
        return RunTask(one.cell.name, settings, locate(one.location).address, one.done)
