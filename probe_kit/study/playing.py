"""Playing of all runs that a plan finds missing, here, in processes or on a Ray cluster, then fitting of probes.

A worker gets all runs of one model, loads the model once, and reports events. Committed episodes stay, so that a
model whose worker is lost, or whose study is started again, resumes after its last episode.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import Any

from probe_kit._execution.executor import GivenUp, Pool, TaskQueue, work_off
from probe_kit._execution.process_pool import ProcessPool, share_of_machine
from probe_kit._execution.ray_pool import RayPool
from probe_kit._system.imports import require
from probe_kit.env import SceneSpec
from probe_kit.errors import (
    DiskSpaceError,
    EpisodesFailedError,
    ProbeKitError,
    RunIncompleteError,
    RunNotFoundError,
    SettingsMismatchError,
    StoreError,
    WorkerDiedError,
)
from probe_kit.extract import prepare
from probe_kit.extract.extraction import open_checked
from probe_kit.extract.rollout.tasks import task_of
from probe_kit.extract.settings import Settings
from probe_kit.runs import seal
from probe_kit.runs.store import locate
from probe_kit.study.cells import NOT_TRIED_AGAIN, Failures, ItemSelection, PlannedRun, StudyFailure
from probe_kit.study.plan import PlannedCell, StudyPlan, probes_of, untrained_cell
from probe_kit.study.reading import LoadedStudy
from probe_kit.study.schema import ProbesTable
from probe_kit.study.stored import open_cell
from probe_kit.train import train_probes

STOPS_ALL = (DiskSpaceError, StoreError)
"""Errors of the place of all runs, which stop the study."""
MOST_LOSSES = 3
"""Number of times that a model's worker may be lost in a row without an episode in between."""
_SECONDS_PER_INFERENCE = 0.1
"""A guess where no rate is known, by which the longest model is found."""


@dataclass(frozen=True)
class RunTask:
    """A run to be played or asked.

    Attributes:
        run: Name of the run in the plan.
        location: An address for any working directory.
        stored: Episodes that were stored when the task was made.
    """

    run: str
    settings: Settings
    location: str
    stored: int


@dataclass(frozen=True)
class ModelTask:
    """Runs of one model.

    Attributes:
        gpus: Number of GPUs that the model needs.
        size: An estimate by which the longest task is found.
    """

    model: str
    runs: tuple[RunTask, ...]
    gpus: int = 0
    size: float = 0.0


@dataclass(frozen=True)
class EpisodeStored:
    """The event that an episode of a run is stored.

    Attributes:
        stored: Number of stored episodes of the run.
        planned: Number of episodes of the whole run.
    """

    model: str
    run: str
    stored: int
    planned: int
    outcome: str


@dataclass(frozen=True)
class RunFinished:
    """The event that a run is whole."""

    model: str
    run: str


Event = EpisodeStored | RunFinished | StudyFailure
Report = Callable[[Event], None]
ProbeProgress = Callable[[str, int, int, str], None]


def conduct_study(
    plan: StudyPlan,
    report: Report | None = None,
    *,
    slots: int = 0,
    ray: str | None = None,
    env_workers: int | None = None,
    retry_failed: bool = False,
) -> list[StudyFailure]:
    """Play and ask everything that a plan finds missing; return the failures, those of before included.

    Every run is checked, and every scene built, before the first one is played. A model that fails stops itself
    alone: episodes that are committed stay, and the next call resumes after them. A run that failed while it was
    played is not tried again until its settings change, or with `retry_failed`.

    Args:
        plan: The plan of the study.
        report: Called with every event as it happens; None for no reports.
        slots: Processes, each with one model at a time; 0 for this process.
        ray: Address of a Ray cluster that plays instead, or `auto`; None for this machine.
        env_workers: Processes that simulate, as in `ExtractSettings`.
        retry_failed: Whether runs are tried again that failed while they were played.

    Raises:
        DiskSpaceError: If the place of the runs is full or cannot be written.
        StoreError: If the object store of the runs cannot be used.
        MissingExtraError: For a cluster, if Ray is not installed.
        UsageError: If no cluster answers.
    """
    if ray is not None:
        require("ray", "ray")
    cells = {planned.cell.name: planned.cell for planned in plan.cells}
    missing = [planned for planned in plan.played if planned.state != "whole"]
    stored, failures = Failures(plan.study.study.folder), list[StudyFailure]()
    if not retry_failed:
        before = (planned.failure for planned in missing)
        failures += [failure for failure in before if failure and failure.stage in NOT_TRIED_AGAIN]
        missing = [planned for planned in missing if not planned.given_up]
    stored.check_place()  # a place that cannot be written is no model's failure
    home, recorded = plan.study.home, set[str]()

    def note(event: Event) -> None:
        if home is not None and not isinstance(event, StudyFailure) and event.run not in recorded:
            recorded.add(event.run)  # with the first episode: a killed run resumes with the same model
            try:
                home.note_played(cells[event.run])
            except SettingsMismatchError as error:
                note(StudyFailure.of("checking", event.model, event.run, error))
        if isinstance(event, RunFinished):
            stored.clear(cells[event.run])
        elif isinstance(event, StudyFailure):
            failures.append(event)
            stored.note(cells[event.run], event)
        if report is not None:
            report(event)

    tasks = list(_checked_tasks(plan, missing, note, ray, env_workers))
    if tasks:
        play_models(tasks, note, slots, ray)
    for planned in plan.played:
        if not planned.sealed:  # its process was killed after the last episode
            seal(locate(planned.location))
        if home is not None and planned.state == "whole":
            home.note_stored(planned.cell)
    return failures


def _checked_tasks(
    plan: StudyPlan, missing: list[PlannedCell], note: Report, ray: str | None, env_workers: int | None
) -> Iterator[ModelTask]:
    """Yield the tasks of all models whose runs pass the checks; the others fail at once."""
    rehearsed: list[SceneSpec] = []
    for model, of_model in groupby(missing, key=lambda planned: planned.cell.model):  # which are in this order
        cells = list(of_model)
        failure = next(filter(None, (_problem(planned, rehearsed, ray) for planned in cells)), None)
        if failure is not None:
            note(failure)
            continue
        size = sum(
            plan.seconds.get(planned.cell.name, _SECONDS_PER_INFERENCE * planned.missing * planned.cell.units)
            for planned in cells
        )
        folder = plan.study.suite.folder
        suite = None if folder is None else folder.resolve()  # a worker may have another working directory
        runs = tuple(
            RunTask(
                planned.cell.name,
                planned.cell.settings_to_play.changed(suite=suite, env_workers=env_workers),
                locate(planned.location).address,
                planned.stored,
            )
            for planned in cells
        )
        yield ModelTask(model, runs, plan.study.study.models[model].gpus, size)


def _problem(planned: PlannedCell, rehearsed: list[SceneSpec], ray: str | None) -> StudyFailure | None:
    """Return the fault of a run that shows without the model.

    Args:
        planned: The run with its state.
        rehearsed: Scenes that can be built; one that was built now is added.
        ray: Address of a Ray cluster, whose devices are not those of this machine.
    """
    cell = planned.cell
    try:
        if planned.state == "damaged":
            raise ProbeKitError(planned.why.removeprefix("damaged: "))
        settings = cell.settings_to_play.changed(ray=ray)  # the devices of a cluster are elsewhere
        decided, source = open_checked(settings, locate(planned.location))
        if (scene := decided.settings.scene) not in rehearsed:
            source.rehearse(source.rows(decided.settings.seed))
            rehearsed.append(scene)
    except STOPS_ALL:
        raise
    except ProbeKitError as error:
        return StudyFailure.of("checking", cell.model, cell.name, error)
    return None


# -- one model ---------------------------------------------------------------------------------------------------


def play_model(task: ModelTask, report: Report) -> None:
    """Load the model and make its runs one after another; failures are reported, and committed episodes stay.

    Episodes that are given up end their run alone; anything else ends the model.

    Args:
        task: The runs of the model.
        report: Called with every event as it happens.

    Raises:
        DiskSpaceError: If the place of all runs is full or cannot be written.
        StoreError: If the object store of all runs cannot be used.
    """
    loaded: dict[bool, Any] = {}  # as policy and as VLM, on first use
    for run in task.runs:
        moved = list[int]()

        # Defaults bind what the loop assigns anew.
        def count(stored: int, planned: int, outcome: str, run: RunTask = run, moved: list[int] = moved) -> None:
            moved.append(stored)
            report(EpisodeStored(task.model, run.run, stored, planned, outcome))

        settings = run.settings
        try:
            if settings.asks not in loaded:
                loaded[settings.asks] = task_of(settings).load(settings)
            extraction = prepare(settings, run.location, loaded[settings.asks])
            extraction.run(run.location, progress=count)
            report(RunFinished(task.model, run.run))
        except STOPS_ALL:
            raise
        except EpisodesFailedError as error:
            some = bool(run.stored or moved)  # without a single episode it is the model that fails
            report(StudyFailure.of("episodes" if some else "playing", task.model, run.run, error))
            if not some:
                return
        except Exception as error:  # noqa: BLE001 - whatever a model raises must not end the others
            report(StudyFailure.of("playing", task.model, run.run, error))
            return


# -- all models --------------------------------------------------------------------------------------------------


def play_models(tasks: Sequence[ModelTask], report: Report, slots: int = 0, ray: str | None = None) -> None:
    """Play models one after the other here, in `slots` processes, or on the cluster `ray`.

    The longest goes first. A model whose worker is lost resumes after what is stored; it fails once it was lost
    `MOST_LOSSES` times without an episode in between. With GPUs each process has one of its own; further processes
    play models that need none. Ray finds room for each model; its nodes see the runs.

    Args:
        tasks: One task per model.
        report: Called with every event as it happens.
        slots: Processes, each with one model at a time; 0 for this process.
        ray: Address of a Ray cluster that plays instead, or `auto`; None for this machine.

    Raises:
        DiskSpaceError: If any worker raises it.
        StoreError: If any worker raises it.
        WorkerDiedError: If workers die before they begin.
        MissingExtraError: For a cluster, if Ray is not installed.
        UsageError: If no cluster answers.
    """
    tasks = sorted(tasks, key=lambda task: -task.size)  # begun last, the longest would be waited for alone
    if ray is None and not slots:
        for task in tasks:
            play_model(task, report)
        return
    needs = [task.gpus for task in tasks]
    if ray is not None:  # a worker for every model, with the GPUs that it needs
        pool: Pool = RayPool(play_here, None, ray, lambda _cluster: needs)
    else:
        device, gpus, size = "cpu", 0, min(slots, len(tasks))
        if any(needs):
            import torch

            device, gpus = "cuda", torch.cuda.device_count()
        pool = ProcessPool(play_here, None, size, partial(share_of_machine, size=size, device=device))

    def fits(slot: int, task: ModelTask) -> bool:
        return needs[slot] == task.gpus if ray is not None else slot < gpus or not task.gpus

    queue = TaskQueue(((task.model, task) for task in tasks), "model", MOST_LOSSES, fits)
    for slot, event in work_off(pool, queue):
        _note(queue, slot, event, report)


def play_here(_setup: None, take: Callable[[], ModelTask], report: Callable[[Event | ModelTask], None]) -> None:
    """Play one model after the other in a worker elsewhere; each is reported when it is played."""
    while True:
        task = take()
        play_model(task, report)
        report(task)


def _note(queue: TaskQueue[ModelTask], slot: int, event: Any, report: Report) -> None:
    """Note and report an event: a run that is made or given up is not played again."""
    if isinstance(event, ModelTask):
        queue.end(slot, event.model)
        return
    if isinstance(event, GivenUp):
        model, run = event.task.model, event.task.runs[0].run
        reason = f"{event.reason}, {MOST_LOSSES} times without an episode in between. Its last words are above"
        report(StudyFailure.of("playing", model, run, WorkerDiedError(reason)))
        return
    if isinstance(event, EpisodeStored):
        queue.advanced(event.model)  # its losses are counted anew: it does not die of one episode
    elif isinstance(event, RunFinished) or event.stage == "episodes":
        task = queue.holds(slot)[event.model]
        runs = tuple(run for run in task.runs if run.run != event.run)
        queue.replace(slot, event.model, replace(task, runs=runs))
    report(event)


# -- probes ------------------------------------------------------------------------------------------------------


def fit_probes(
    plan: StudyPlan, progress: ProbeProgress | None = None, jobs: int | None = None
) -> list[StudyFailure]:
    """Fit the probes of a study file that a plan does not find stored; return the failures.

    A failure of stage `waiting` marks a run that is not whole yet; others are stored with the study.

    Args:
        plan: The plan of the study.
        progress: Called with the run's name, sites done, sites in all and the last one.
        jobs: Processes, as in `train_probes`.
    """
    stored, failures = Failures(plan.study.study.folder), list[StudyFailure]()
    fitted = {
        (planned.cell.name, name) for planned in plan.cells for name, why in planned.probes.items() if not why
    }
    for cell in (planned.cell for planned in plan.cells):
        for name, table, selection in probes_of(plan.study, cell):
            if (cell.name, name) in fitted:
                continue
            try:
                _fit(plan.study, table, cell, selection, progress, jobs)
            except (RunNotFoundError, RunIncompleteError) as error:
                failures.append(StudyFailure.of("waiting", cell.model, cell.name, error))
            except ProbeKitError as error:
                failures.append(StudyFailure.of("probes", cell.model, cell.name, error))
                stored.note(cell, failures[-1], name)
            else:
                stored.clear(cell, name)
    return failures


def _fit(
    study: LoadedStudy,
    table: ProbesTable,
    cell: PlannedRun,
    selection: ItemSelection,
    progress: ProbeProgress | None,
    jobs: int | None,
) -> None:
    probed, network = open_cell(study, cell, selection), untrained_cell(study, table, cell)
    untrained = None if network is None else open_cell(study, network, selection)
    baselines = tuple(name for name in table.controls if name != "untrained")

    def report(sites_done: int, sites: int, last: str) -> None:
        if progress is not None:
            progress(cell.name, sites_done, sites, last)

    train_probes(
        probed.run.in_wording(),
        views=table.views,
        permutations=table.permutations,
        target=table.target,
        controls=baselines or None,
        suite=study.suite.folder,
        untrained=None if untrained is None else untrained.run.in_wording(),
        seed=table.seed,
        jobs=jobs,
        progress=report,
    )
