"""Extraction: workers play every episode that is not committed; then the run is sealed."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit._system.counting import counted
from probe_kit._terminal.notebook import notebook_progress
from probe_kit.errors import EpisodesFailedError, UsageError
from probe_kit.extract.events import Done, Failed
from probe_kit.extract.needs import space_needed
from probe_kit.extract.plan import Plan
from probe_kit.extract.preparation import CheckCameras, Prepared, load, open_checked
from probe_kit.extract.rollout.task import task_of
from probe_kit.extract.settings import AskSettings, ExtractSettings, Settings, run_label
from probe_kit.extract.workers import play
from probe_kit.hashing import canonical_json
from probe_kit.runs.commits import failure_key
from probe_kit.runs.disk import check_if_full
from probe_kit.runs.growth import check_other_settings, further_rows
from probe_kit.runs.label import label_run
from probe_kit.runs.layout import RUN_FILE
from probe_kit.runs.location import Location
from probe_kit.runs.root import read_root
from probe_kit.runs.run import Run, open_run
from probe_kit.runs.sealing import seal
from probe_kit.runs.store import locate
from probe_kit.runs.writer import RunWriter

if TYPE_CHECKING:
    from probe_kit.hooks import Model

Progress = Callable[[int, int, str], None]
# If this many episodes were given up and none succeeded, something is wrong with all of them.
HOPELESS = 3


class Extraction(Prepared):
    """A prepared extraction, ready to run; so far nothing is written."""

    def run(self, out: Path | str | Location, force: bool = False, progress: Progress | None = None) -> Run:
        """Play and commit every episode of the plan that is not committed yet, seal the run and open it.

        A run that lacks episodes of the plan grows by them. One that has more than these stays as it is.
        progress: called with (episodes done, episodes planned, outcome of the last one); by default a bar in a
        notebook, nothing elsewhere.
        Raises SettingsMismatchError or DiskSpaceError before anything is written, StoreError if `out` lies in an
        object store that cannot be used, as one that ignores conditional puts, EpisodesFailedError at the end if
        episodes were given up, and whatever is wrong with all episodes at once. Committed episodes stay; the same
        call resumes after them.
        """
        location = locate(out)
        if self.declared:
            raise UsageError("this extraction was planned without its model; prepare it again with fetch=True")
        with location.in_words():
            self._check_settings(location)
            if not force and (addition := self.further_plan(location)).episodes:
                check_if_full(space_needed(addition, self.settings), location)
            writer = self.writer(location)
            with writer.owned():
                location.check_exclusive(RUN_FILE)
                if self.settings.label is not None:
                    label_run(location, run_label(self.settings))
                remaining = writer.remaining()
                if remaining:
                    writer.begin(self.settings.machine.allow_mixed)
                    self._play(writer, remaining, progress or notebook_progress("episodes"))
                seal(location)
        return open_run(location)

    def _check_settings(self, location: Location) -> None:
        """Raise SettingsMismatchError if a run with other settings is there: before its plan is compared."""
        if location.exists(RUN_FILE):
            root = read_root(location)
            root.check_continuable()
            check_other_settings(root.own_settings, json.loads(canonical_json(self.identity())), str(location))

    def further_plan(self, location: Location) -> Plan:
        """The plan of the episodes that the run at `location` does not plan yet: all of them where there is none.

        Raises SettingsMismatchError if the run there cannot grow by this plan, and RunDamagedError.
        """
        if not location.exists(RUN_FILE):
            return self.plan
        root = read_root(location)
        root.check_continuable()
        added = {
            planned["episode_id"]
            for planned in further_rows(root.plan, self.plan.to_json()["episodes"], str(location))
        }
        return self.plan.only(row for row in self.plan.episodes if row.episode_id in added)

    def _play(self, writer: RunWriter[Plan], remaining: list[int], progress: Progress | None) -> None:
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


def _failure(writer: RunWriter[Plan], given_up: list[Failed], committed: int) -> EpisodesFailedError:
    error = EpisodesFailedError(
        f"{counted(len(given_up), 'episode')} failed twice and were given up; {committed} others were finished "
        "and are kept. The same command tries them again; --partial reads the run without them"
    )
    for failed in given_up:
        where = f" (traceback in {writer.location}/{failure_key(failed.number)})" if failed.traceback else ""
        error.add_note(f"{writer.plan.episode(failed.number).episode_id}: {failed.reason}{where}")
    return error


def prepare(
    settings: Settings,
    out: Path | str | Location | None = None,
    model: "Model | None" = None,
    fetch: bool = True,
    check_cameras: CheckCameras | None = None,
) -> Extraction:
    """Find the suite, load the model and plan the episodes.

    out: where it will be written, if that is known; what is wrong there is then said before the model is loaded.
    model: the policy or answer model of these settings, if it is loaded already; several runs can share it.
    Workers load their own. fetch: False plans with the streams that the family declares, without weights, network
    or GPU; such an extraction cannot be run. check_cameras: called with the cameras that get a picture, see
    `load`.
    Raises what these raise: UnknownModelError, UnknownCategoryError, SuiteError, WeightsError …
    """
    location = None if out is None else locate(out)
    if not settings.machine.elsewhere:
        prepared = load(settings, location=location, model=model, fetch=fetch, check_cameras=check_cameras)
        return Extraction(**vars(prepared))
    # This process only plans: the GPUs belong to the workers, and each of them calibrates on its own device.
    measures = {"batch": 1} if settings.machine.batch == "auto" else {}
    on_cpu = settings.changed(device="cpu", **measures)
    planned = load(on_cpu, location=location, model=model, fetch=fetch, check_cameras=check_cameras)
    for_workers = planned.settings.changed(device=settings.machine.device, batch=settings.machine.batch)
    return Extraction(for_workers, planned.source, planned.plan, planned.card, None, declared=planned.declared)


def extract_run(settings: ExtractSettings, out: Path | str, progress: Progress | None = None) -> Run:
    """Extract a run to a folder or a URL such as `s3://bucket/prefix/run`, or continue the one that is there."""
    return prepare(settings, out).run(out, progress=progress)


def ask_run(settings: AskSettings, out: Path | str, progress: Progress | None = None) -> Run:
    """Ask a model about every episode of a plan, or continue the run that is there; see `extract_run`."""
    return prepare(settings, out).run(out, progress=progress)


def prepare_asks(
    settings: Sequence[AskSettings], outs: Sequence[Path | str | Location | None], fetch: bool = True
) -> Iterator[Extraction]:
    """Several runs of one model, which is loaded once; each is prepared when its turn comes.

    fetch: as of `prepare`.
    What is wrong with any of them, as far as it is known without the model, is said before the first.
    Raises what `prepare` raises.
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
