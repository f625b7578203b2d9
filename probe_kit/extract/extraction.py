"""Extraction, from settings to a run: open the source, check, load the model, plan, play in workers, seal."""

import json
import os
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from signal import SIGALRM
from typing import TYPE_CHECKING, Any

from probe_kit._execution.executor import GivenUp, Pool, TaskQueue, work_off
from probe_kit._execution.process_pool import ProcessPool, share_of_machine
from probe_kit._execution.ray_pool import RayPool
from probe_kit._system.counting import plural
from probe_kit._system.imports import install_command
from probe_kit._system.types import Progress
from probe_kit._terminal.notebook import notebook_progress
from probe_kit.errors import DiskSpaceError, EpisodesFailedError, MissingExtraError, UsageError
from probe_kit.extract.parts import SCRIPTED
from probe_kit.extract.rollout.calibration import Calibration
from probe_kit.extract.rollout.controllers import Controller
from probe_kit.extract.rollout.tasks import LoadedModel, task_of
from probe_kit.extract.rollout.worker import Worker
from probe_kit.extract.settings import CONFIG, AskSettings, ExtractSettings, Settings, run_label
from probe_kit.extract.sizes import planned_sizes, space_needed
from probe_kit.extract.sources.player import Done, Event, Failed
from probe_kit.extract.sources.source import Source, raise_together
from probe_kit.extract.states import Decided, Fitted
from probe_kit.hashing import canonical_json, sha256_json
from probe_kit.hooks.registry import find_family, get_family
from probe_kit.runs.commits import failure_key
from probe_kit.runs.layout import GROUP_FILE, RUN_FILE, UNITS, StoredStream
from probe_kit.runs.plan import Plan, Row, further_rows
from probe_kit.runs.provenance import provenance_here
from probe_kit.runs.root import find_continuable, label_run
from probe_kit.runs.run import Run
from probe_kit.runs.run_folders import check_if_full
from probe_kit.runs.store import Location, check_exclusive, locate
from probe_kit.runs.verify import seal
from probe_kit.runs.writer import RunWriter, check_other_settings

if TYPE_CHECKING:
    from probe_kit.hooks import Model


CheckCameras = Callable[[Sequence[str]], object]
"""A function that gets the names of the model's cameras that get a picture, and raises UsageError."""
ChooseRows = Callable[[Sequence[Row]], Sequence[Row]]
"""A function that returns some of the rows that a source has, or raises UsageError."""
# If this many episodes were given up and none succeeded, something is wrong with all of them.
HOPELESS = 3
_OF_THE_CHECKPOINT = ("dtype", "execute", "random_weights", "captured_calls")
"""The settings whose value the loaded model may decide."""


@dataclass(frozen=True)
class Extraction:
    """A prepared extraction, ready to run: the source is open, the model is loaded and the plan is made.

    Attributes:
        fitted: The settings, fitted to the model.
        source: The source as the model is shown it.
        card: The part of the identity that the loaded model decides.
        loaded: The model, loaded here. None: workers elsewhere load it again, or none was loaded.
        declared: The origin of the sizes of the streams, where no model was loaded and the run has no name yet.
            Empty where a model was loaded.
        row_ids: The ids of the planned rows, where only some of the source's are planned; else None.
    """

    fitted: Fitted[Settings]
    source: Source[Any]
    plan: Plan
    card: dict[str, Any]
    loaded: LoadedModel | None
    declared: str = ""
    row_ids: tuple[str, ...] | None = None

    @property
    def settings(self) -> Settings:
        """The settings by part."""
        settings: Settings = self.fitted.settings
        return settings

    @property
    def controller(self) -> Controller | None:
        """The controller of the model that is loaded here, if any."""
        return None if self.loaded is None else self.loaded.controller

    @property
    def calibration(self) -> Calibration | None:
        """The measurement that chose the batch; None if it was not requested or is left to workers."""
        return None if self.loaded is None else self.loaded.calibration

    def identity(self) -> dict[str, Any]:
        """Return everything that decides the numbers of an episode, without selection, machine and label.

        Runs with equal identity have equal numbers in the episodes that both have.
        """
        return {**self.settings.identity(), **self.card, **self.plan.identity}

    def provenance(self) -> dict[str, Any]:
        """Return the provenance of a process that plays with these settings here, with its video decoder."""
        dtype: str | None = self.card.get("dtype")
        decoder = {} if self.plan.decoder is None else {"decoder": self.plan.decoder}
        return provenance_here(self.settings.machine.device, dtype) | decoder

    def writer(self, location: Location) -> RunWriter:
        """Return a writer of the run at `location`, which it begins or continues.

        Raises:
            SettingsMismatchError: If the location holds a run with other settings.
        """
        return RunWriter(location, self.plan, self.identity(), self.provenance(), run_label(self.settings))

    def default_name(self) -> str:
        """Return a folder name that repeats for the same settings, so that the same command finds its run again.

        A command with more items finds it too; one with other categories, wordings or another suite does not.
        """
        hashed = [self.identity(), *self.plan.name_parts]
        # Without the weights' hash there is no name yet.
        return self.settings.folder_name("…" if self.declared else sha256_json(hashed)[:8])

    def worker(self, writer: RunWriter, episodes: int) -> Worker:
        """Return a worker of this process, which plays at most `episodes` episodes with the loaded model."""
        assert self.loaded is not None
        return Worker(writer, self.fitted, self.loaded.controller, self.loaded.observations, self.source, episodes)

    def run(self, out: Path | str | Location, force: bool = False, progress: Progress | None = None) -> Run:
        """Play and commit every episode of the plan that is not committed yet, seal the run and open it.

        A run that lacks episodes of the plan grows by them. One that has more than these stays as it is. Committed
        episodes stay; the same call resumes after them. An error that concerns all episodes at once is raised as
        it is.

        Args:
            out: The folder or URL of the run.
            force: Start even if the disk seems too small.
            progress: Called with (episodes done, episodes planned, outcome of the last one); by default a bar in a
                notebook, nothing elsewhere.

        Raises:
            UsageError: If the extraction was planned without its model.
            SettingsMismatchError: Before anything is written, if `out` holds a run with other settings.
            DiskSpaceError: Before anything is written, if the disk is too small.
            StoreError: If `out` lies in an object store that cannot be used, such as one that ignores conditional
                puts.
            EpisodesFailedError: At the end, if episodes were given up.
        """
        location = locate(out)
        if self.declared:
            raise UsageError("this extraction was planned without its model; prepare it again with fetch=True")
        with location.explained_errors():
            addition = self.further_plan(location)
            if not force and addition.episodes:
                check_if_full(space_needed(addition, self.fitted), location)
            writer = self.writer(location)
            with writer.claim():
                check_exclusive(location, GROUP_FILE, writer.root.stored_metadata[GROUP_FILE])
                if self.settings.label is not None:
                    label_run(location, run_label(self.settings))
                remaining = writer.remaining()
                if remaining:
                    writer.begin(self.settings.machine.allow_mixed)
                    self._play(writer, remaining, progress or notebook_progress("episodes"))
                seal(location)
            return writer.opened()

    def further_plan(self, location: Location) -> Plan:
        """Return the plan of the episodes that the run at `location` does not plan yet; all if there is none.

        Raises:
            SettingsMismatchError: If the run there cannot grow by this plan.
            RunDamagedError: If the run there was changed.
        """
        root = find_continuable(location)
        if root is None:
            return self.plan
        if not self.declared:  # first of all: what has other settings has other episodes too
            check_other_settings(root.own_settings, json.loads(canonical_json(self.identity())), str(location))
        added = {row["episode_id"] for row in further_rows(root.plan, self.plan.columns, location)}
        return self.plan.only(row for row in self.plan.episodes if row.episode_id in added)

    def _play(self, writer: RunWriter, remaining: list[int], progress: Progress | None) -> None:
        total, committed, given_up = len(self.plan.episodes), 0, list[Failed]()
        with closing(play(self, writer, remaining)) as events:
            for event in events:
                if isinstance(event, Done):
                    committed += 1
                    if progress:
                        progress(total - len(remaining) + committed, total, event.outcome["outcome"])
                    continue
                given_up.append(event)
                writer.give_up(event.number, event.reason, event.traceback)
                if len(given_up) >= HOPELESS and not committed:
                    raise _failure(writer, given_up, committed)
        if given_up:
            seal(writer.location)
            raise _failure(writer, given_up, committed)


def load(
    settings: Settings,
    rehearsed: bool = False,
    location: Location | None = None,
    model: "Model | None" = None,
    fetch: bool = True,
    check_cameras: CheckCameras | None = None,
    choose_rows: ChooseRows | None = None,
) -> Extraction:
    """Open the source, load the model and plan the rows.

    Args:
        settings: The settings as they are requested.
        rehearsed: Whether the source was tried before.
        location: The place of the run, if it is known, so that it is checked before the model is loaded.
        model: The policy or answer model of these settings, if it is loaded already. It may be one of your own,
            and several runs can share it.
        fetch: False makes the plan of the streams that the model's family declares: without weights, network or
            GPU. A family that declares none is loaded.
        check_cameras: Called once the cameras are known, before weights are loaded where the checkpoint's files
            name them, and again with those of the loaded model.
        choose_rows: Called before weights are loaded; only the rows that it returns are planned. None for all.

    Raises:
        UsageError: For a policy of another family or with other weights than the settings name.
        UnknownModelError: For an unknown family.
        UnknownCategoryError: For a category that the suite lacks.
        SuiteError: For a suite that cannot be used.
        RecordingError: For recordings that cannot be used.
        OwnEnvironmentError: For an environment that breaks its contract.
        WeightsError: For weights that do not fit.
        ProbeKitError: For any other fault of settings, source or model.
    """
    decided, source = open_checked(settings, location, model is not None, fetch)
    task = task_of(decided.settings)
    rows = _select_rows(task.rows(decided.settings, source), choose_rows)
    if not rehearsed:
        source.rehearse(rows)
    if model is not None:
        task.check_loaded(decided, model)
    else:
        raise_together(task.early_checks(decided, source, fetch))
    if check_cameras is not None and (early := source.shown_cameras(task.declared_inputs(decided))) is not None:
        check_cameras(early)
    if not fetch and (sizes := planned_sizes(decided.settings, source.instructions)) is not None:
        fitted = task.planned(decided, sizes)
        requested, execute = fitted.settings.model, fitted.settings.task.execute
        plan = _plan(fitted, source, rows, sizes.streams, execute or sizes.execute)
        card = {"model": requested.family, "random_weights": requested.random_weights, "weights_sha256": None}
        declared = {"dtype": requested.dtype, "execute": execute}
        card |= {name: value for name, value in declared.items() if value is not None}
        return Extraction(fitted, source, plan, card, None, sizes.source, _ids(rows, choose_rows))
    fitted, source, loaded = task.fit(decided, source, task.load(decided.settings) if model is None else model)
    controller = loaded.controller
    if check_cameras is not None and (cameras := source.shown_cameras()) is not None:
        check_cameras(cameras)
    rows = _select_rows(task.rows(fitted.settings, source), choose_rows)  # of the source as the model is shown it
    plan = _plan(fitted, source, rows, controller.streams, controller.execute)
    row_ids = _ids(rows, choose_rows)
    return Extraction(fitted, source, plan, controller.identity, loaded, row_ids=row_ids)


def _select_rows(rows: tuple[Row, ...], choose: ChooseRows | None) -> tuple[Row, ...]:
    """Return the chosen rows, numbered anew in their order; all without a choice."""
    if choose is None:
        return rows
    return tuple(replace(row, index=number) for number, row in enumerate(choose(rows)))


def _ids(rows: Sequence[Row], choose: ChooseRows | None) -> tuple[str, ...] | None:
    return None if choose is None else tuple(row.episode_id for row in rows)


def _rows_of(ids: Sequence[str], rows: Sequence[Row]) -> list[Row]:
    """Return the rows with these ids, in their order."""
    by_id = {row.episode_id: row for row in rows}
    return [by_id[name] for name in ids]


def open_checked[Chosen: Settings](
    settings: Chosen, location: Location | None = None, loaded: bool = False, fetch: bool = True
) -> tuple[Decided[Chosen], Source[Any]]:
    """Return the settings with what protocol and source decide, and the open source. Raises as `load`.

    All is checked that needs no model.

    Args:
        settings: The settings as they are requested.
        location: The place of the run, if it is known.
        loaded: Whether the model is loaded already; it may be one that no name leads to.
        fetch: Whether a checkpoint of the hub is downloaded and its weights are looked up; else only files on this
            machine are read, see `Family.check`.
    """
    check_meaningless(settings)
    settings = settings.followed()
    task = task_of(settings)
    if not loaded:
        check_model(settings, fetch)
    if location is not None:
        _check_writable(location)
    source = task.view_of(settings.source.open(not fetch and _selects_only(settings, location)))
    by_source = {name: value for name, value in source.decided().items() if name in settings.names()}
    decided = Decided(settings.changed(**by_source) if by_source else settings)
    model = decided.settings.model
    if not loaded and model.family not in SCRIPTED:
        family = find_family(model.family, tuple(SCRIPTED))
        family.check_words(task.texts(decided.settings, source), model.checkpoint)
    if location is not None:
        _check_other_run(decided, source, location)
    return decided, source


# -- checks that need no model --------------------------------------------------------------------------------


def check_meaningless(settings: Settings) -> None:
    """Raise UsageError for settings that would have no effect with this source, task or model."""
    model, source = settings.model, settings.source
    if model.weights_seed and not model.random_weights:
        raise UsageError(
            f"--weights-seed {model.weights_seed} seeds random weights, and the checkpoint's were asked for. "
            "Leave it out, or add --random-weights"
        )
    settings.refuse(source.refuses, f"does not apply with {source.shows}; remove it")
    task_of(settings).check_meaningless(settings)


def check_model(settings: Settings, fetch: bool = True) -> None:
    """Refuse a model, option, device or checkpoint that cannot be used; imports no torch.

    Args:
        settings: The settings of the run.
        fetch: Whether a checkpoint of the hub is downloaded and its weights are looked up; else only files on this
            machine are read, see `Family.check`.

    Raises:
        UnknownModelError: For an unknown family.
        MissingExtraError: For workers on a Ray cluster without Ray.
        ProbeKitError: For whatever else `Family.check` refuses.
    """
    if settings.machine.ray is not None and find_spec("ray") is None:
        raise MissingExtraError(f"--ray needs ray, which is not installed. Install it: `{install_command('ray')}`")
    model, scripts = settings.model, tuple(SCRIPTED)
    family = None if model.family in SCRIPTED else find_family(model.family, scripts)
    task_of(settings).check_family(settings, family)
    if family is None:
        return
    # Elsewhere there may be other devices than here.
    device = "cpu" if settings.machine.elsewhere else settings.machine.device
    family.check(
        model.checkpoint, device, model.dtype, model.random_weights, model.options, model.weights_seed, fetch
    )


def _check_writable(location: Location) -> None:
    """Raise UsageError for a place that cannot be written, DiskSpaceError for a read-only disk."""
    if "://" in location.address:
        return  # a bucket says so itself, and creating anything there is no check
    folder = Path(location.address)
    nearest = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if not nearest.is_dir():
        raise UsageError(f"{location} cannot be used: {nearest} is not a folder. Give another path")
    if os.statvfs(nearest).f_flag & os.ST_RDONLY:
        raise DiskSpaceError(
            f"{location} cannot be used: the disk of {nearest} is read-only. Choose another --out"
        )
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise UsageError(f"{location} cannot be used: {nearest} cannot be written. Give another path")


def _check_other_run(decided: Decided[Settings], source: Source[Any], location: Location) -> None:
    """Raise SettingsMismatchError for a location that holds a run with other settings, or one that cannot grow so.

    Only what is known without the model is compared; the writer compares all of it.

    Raises:
        RunDamagedError: If the run at the location was changed.
    """
    early = source.known_early()
    with location.explained_errors():
        root = None if early is None else find_continuable(location)
        if early is None or root is None:
            return
        settings = decided.settings
        comparable = {name: value for name, value in settings.identity().items() if name not in _OF_THE_CHECKPOINT}
        requested = json.loads(canonical_json({**comparable, **early}))
        stored = {name: root.own_settings[name] for name in requested if name in root.own_settings}
        check_other_settings(stored, {name: requested[name] for name in stored}, str(location))
        if root.plan:
            rows = task_of(settings).rows(settings, source)
            further_rows(root.plan, [row.to_json() for row in rows], location)


def _selects_only(settings: Settings, location: Location | None) -> bool:
    """Whether only the chosen items of the suite are needed, and not the suite as a whole.

    Names of runs that are known before they are played hold the hash of the whole suite, and so does an existing
    run. Questions name objects of all its items.
    """
    if task_of(settings).names_all_items:
        return False
    if location is None:
        family = get_family(settings.model.family)
        return family is not None and bool(family.checkpoints.declared)
    with location.explained_errors():
        return not location.exists(RUN_FILE)


# -- the plan -------------------------------------------------------------------------------------------------


def _plan(
    fitted: Fitted[Settings],
    source: Source[Any],
    rows: tuple[Row, ...],
    streams: Iterable[StoredStream],
    execute: int,
) -> Plan:
    """Return the plan of rows that store these streams, with `execute` actions per inference, 0 for none."""
    settings, streams = fitted.settings, tuple(streams)
    capture = settings.capture
    notes = source.unit_notes(settings.machine.accept_units)
    units = {UNITS: {name: asdict(note) for name, note in notes.items()}} if notes else {}
    size = sum(stream.raw_bytes(capture.tokens == "all", fitted.calls, capture.later_views) for stream in streams)
    return Plan(
        rows,
        streams,
        size * len(rows),
        source.identity(execute),
        {**source.selection(rows), **units, CONFIG: settings.stored_config()},
        source.name_parts(),
        source.suite_parent,
        source.decoder,
    )


# -- workers -----------------------------------------------------------------------------------------------------


def play(prepared: Extraction, writer: RunWriter, numbers: list[int]) -> Generator[Event]:
    """Play episodes where the settings say; yield `Done` of each, or `Failed` once it is given up.

    They are played in this process with the loaded model, else in workers that load their own, to which only
    episode numbers are sent. An episode that fails, or is lost with its worker, is tried once more.

    Raises:
        WorkerDiedError: If workers die before they begin.
        MissingExtraError: Without Ray.
        UsageError: If no Ray cluster answers.
        ProbeKitError: The error that a worker raises.
    """
    queue = TaskQueue(((number, number) for number in numbers), "episode")
    settings = prepared.settings
    if settings.machine.ray or settings.machine.workers:
        events = work_off(_pool(prepared, writer.location.address), queue)
    else:
        events = _played_here(prepared, writer, queue, len(numbers))
    for slot, event in events:
        if isinstance(event, GivenUp):
            yield Failed(event.task, f"the worker that played it was lost: {event.reason}")
        elif isinstance(event, Done):
            queue.end(slot, event.number)
            yield event
        elif not queue.retry(slot, event.number):
            yield event


def play_episodes(
    setup: tuple[Settings, str, tuple[str, ...] | None],
    take: Callable[[], int | None],
    report: Callable[[Event], None],
) -> None:
    """Do the work of a worker elsewhere: load the model, then play the episodes that are handed out.

    The settings of the run are a request to it: what this machine decides, such as a batch, it decides anew.

    The run is held meanwhile.

    Raises:
        SettingsMismatchError: If this machine has other settings or gives other numbers than those before it.
    """
    settings, run, row_ids = setup
    prepared = load(settings, rehearsed=True, choose_rows=None if row_ids is None else partial(_rows_of, row_ids))
    writer = prepared.writer(locate(run))
    with writer.take_part():
        writer.begin(settings.machine.allow_mixed)
        with prepared.worker(writer, len(writer.remaining())) as worker:
            while True:
                for event in worker.run(take):
                    report(event)


def _played_here(
    prepared: Extraction, writer: RunWriter, queue: TaskQueue[int], episodes: int
) -> Iterator[tuple[int, Event]]:
    with prepared.worker(writer, episodes) as worker:
        while not queue.finished:
            yield from ((0, event) for event in worker.run(lambda: queue.take(0)))


def _pool(prepared: Extraction, run: str) -> Pool:
    settings = prepared.settings
    setup = settings, run, prepared.row_ids
    if settings.machine.ray:
        return RayPool(play_episodes, setup, settings.machine.ray, partial(_gpus, settings))
    share = partial(share_of_machine, size=settings.machine.workers, device=settings.machine.device)
    limit = settings.machine.inference_limit
    exits = {
        -SIGALRM: f"was ended, because a call of its model took longer than --inference-limit {limit:g} s"
    } if limit is not None else None  # fmt: skip
    return ProcessPool(play_episodes, setup, settings.machine.workers, share, exits)


def _gpus(settings: Settings, resources: Mapping[str, Any]) -> list[int]:
    """Return the GPUs of each actor: as many actors as GPUs, or as the settings say."""
    gpus = int(resources.get("GPU", 0)) if settings.machine.device.startswith("cuda") else 0
    return [1 if gpus else 0] * (settings.machine.workers or max(1, gpus))


def _failure(writer: RunWriter, given_up: list[Failed], committed: int) -> EpisodesFailedError:
    error = EpisodesFailedError(
        f"{plural(len(given_up), 'episode')} failed twice and were given up; {committed} others were finished "
        "and are kept. The same command tries them again; --partial reads the run without them"
    )
    for failed in given_up:
        where = f" (traceback in {writer.location}/{failure_key(failed.number)})" if failed.traceback else ""
        error.add_note(f"{writer.plan.episode(failed.number).episode_id}: {failed.reason}{where}")
    return error


# -- from settings to a run --------------------------------------------------------------------------------------


def prepare(
    settings: Settings,
    out: Path | str | Location | None = None,
    model: "Model | None" = None,
    fetch: bool = True,
    check_cameras: CheckCameras | None = None,
    choose_rows: ChooseRows | None = None,
) -> Extraction:
    """Find the suite, load the model and plan the episodes. Raises as `load`.

    Args:
        settings: The settings of the run.
        out: The folder or URL of the run, if it is known. Faults there are then raised before the model is loaded.
        model: The policy or answer model of these settings, if it is loaded already; several runs can share it.
            Workers load their own.
        fetch: False plans with the streams that the family declares, without weights, network or GPU; such an
            extraction cannot be run.
        check_cameras: Called with the cameras that get a picture, see `load`.
        choose_rows: Returns the rows that are planned, see `load`.

    Raises:
        UnknownModelError: For an unknown family.
        UnknownCategoryError: For a category that the suite lacks.
        SuiteError: For a suite that cannot be used.
        WeightsError: For weights that do not fit.
    """
    location = None if out is None else locate(out)
    load_with = partial(
        load, location=location, model=model, fetch=fetch, check_cameras=check_cameras, choose_rows=choose_rows
    )
    if not settings.machine.elsewhere:
        return load_with(settings)
    # This process only plans: the GPUs belong to the workers, and each of them calibrates on its own device.
    measures = {"batch": 1} if settings.machine.batch == "auto" else {}
    planned = load_with(settings.changed(device="cpu", **measures))
    for_workers = planned.settings.changed(device=settings.machine.device, batch=settings.machine.batch)
    return replace(planned, fitted=replace(planned.fitted, settings=for_workers), loaded=None)


def extract_run(settings: ExtractSettings, out: Path | str, progress: Progress | None = None) -> Run:
    """Extract a run to a folder or a URL such as `s3://bucket/prefix/run`, or continue the one that is there."""
    return prepare(settings, out).run(out, progress=progress)


def ask_run(settings: AskSettings, out: Path | str, progress: Progress | None = None) -> Run:
    """Ask a model about every episode of a plan, or continue the run that is there; see `extract_run`."""
    return prepare(settings, out).run(out, progress=progress)


def prepare_asks(
    settings: Sequence[AskSettings], outs: Sequence[Path | str | Location | None], fetch: bool = True
) -> Iterator[Extraction]:
    """Yield several runs of one model, which is loaded once; each is prepared when its turn comes.

    Faults of any of them that are known without the model are raised before the first is prepared. Raises as
    `prepare`.

    Args:
        settings: The settings of every run; the model of the first one is loaded.
        outs: The folder or URL of every run, None where it is not known yet.
        fetch: False plans without weights, see `prepare`.
    """
    for one_run, out in zip(settings, outs, strict=True):
        open_checked(one_run, None if out is None else locate(out), fetch=fetch)
    if not fetch:
        yield from (prepare(one_run, out, fetch=False) for one_run, out in zip(settings, outs, strict=True))
        return
    first = settings[0].changed(device="cpu") if settings[0].machine.elsewhere else settings[0]
    model = task_of(first).load(first)
    for one_run, out in zip(settings, outs, strict=True):
        yield prepare(one_run, out, model)
