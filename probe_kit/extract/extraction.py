"""Extraction: plan, load, let the workers play every remaining episode, seal."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from probe_kit.errors import EpisodesFailedError, StoreError
from probe_kit.extract.crews.processes import run_here, run_in_processes, run_on_ray
from probe_kit.extract.crews.scheduler import Done, Event, Scheduler
from probe_kit.extract.plan import Plan, make_plan
from probe_kit.extract.play.controllers import SCRIPTED, Controller, PolicyController, ScriptedController
from probe_kit.extract.play.worker import Worker
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.store.commits import write_failure
from probe_kit.extract.store.disk import refuse_if_full
from probe_kit.extract.store.layout import RUN_FILE
from probe_kit.extract.store.location import Location, locate
from probe_kit.extract.store.run import Run, open_run
from probe_kit.extract.store.sealing import seal
from probe_kit.extract.store.writer import RunWriter
from probe_kit.identity import sha256_json
from probe_kit.suite import Suite, default_suite, load_suite

Progress = Callable[[int, int, str], None]
# If this many episodes were given up and none succeeded, something is wrong with all of them.
HOPELESS = 3


class SingleWriterWarning(UserWarning):
    """The object store cannot keep two writers apart; this process must stay the only one."""


@dataclass(frozen=True)
class Extraction:
    """A prepared extraction: the model was loaded and the plan is made, nothing is written.

    controller: None if the model is loaded again by workers elsewhere.
    """

    settings: ExtractSettings
    plan: Plan
    card: dict[str, Any]
    controller: Controller | None

    def identity(self) -> dict[str, Any]:
        """Everything that names the stored numbers; two runs with equal identity are interchangeable."""
        suite = self.plan.suite
        return {
            **self.settings.choices(),
            **self.card,
            "suite": {"identity": suite.identity, "content_sha256": suite.content_sha256},
            "categories": list(suite.categories),
            "items": len(suite.items),
            "scene": self.settings.scene.to_json(),
        }

    def default_name(self) -> str:
        """Folder name that repeats for the same settings, so that the same command finds its run again."""
        return f"{self.settings.model}-{sha256_json(self.identity())[:8]}"

    def run(self, out: Path | str | Location, force: bool = False, progress: Progress | None = None) -> Run:
        """Play and commit every episode that is not committed yet, seal the run and open it.

        progress: called with (episodes done, episodes planned, outcome of the last one).
        Raises SettingsMismatchError or DiskSpaceError before anything is written, StoreError if `out` lies in an
        object store that cannot be used so, EpisodesFailedError at the end if episodes were given up, and whatever
        is wrong with all episodes at once. Committed episodes stay, and the same call continues behind them.
        """
        location = locate(out)
        if not force and not location.exists(RUN_FILE):
            refuse_if_full(self.plan, location)
        with location.in_words():
            writer = RunWriter(location, self.plan, self.identity())
            with writer.owned():
                self._check_exclusive(writer)
                remaining = writer.remaining()
                if remaining:
                    self._play(writer, remaining, progress)
                seal(location)
        return open_run(location)

    def _check_exclusive(self, writer: RunWriter) -> None:
        if writer.several_may_write():
            return
        seen = (
            f"{writer.location}: the store ignores conditional puts (If-None-Match) and keeps no two writers apart"
        )
        if self.settings.workers > 1 or self.settings.ray:
            raise StoreError(f"{seen}. Leave out --workers and --ray, or use another store")
        warnings.warn(f"{seen}; make sure that no second process extracts here", SingleWriterWarning, stacklevel=3)

    def _play(self, writer: RunWriter, remaining: list[int], progress: Progress | None) -> None:
        scheduler = Scheduler(remaining)
        total = len(self.plan.episodes)

        def heard(event: Event) -> None:
            if progress and isinstance(event, Done):
                progress(total - len(remaining) + len(scheduler.done), total, event.outcome["outcome"])
            if event.number in scheduler.given_up:
                episode = self.plan.episodes[event.number].episode
                write_failure(writer.location, event.number, episode.episode_id, scheduler.given_up[event.number])
            if len(scheduler.given_up) >= HOPELESS and not scheduler.done:
                raise self._failure(scheduler)

        if self.settings.ray:
            run_on_ray(self.settings, writer.location.address, scheduler, heard)
        elif self.settings.workers:
            run_in_processes(self.settings, writer.location.address, scheduler, heard)
        else:
            run_here(self, writer, scheduler, heard)
        if scheduler.given_up:
            seal(writer.location)
            raise self._failure(scheduler)

    def _failure(self, scheduler: Scheduler) -> EpisodesFailedError:
        error = EpisodesFailedError(
            f"{len(scheduler.given_up)} episodes failed twice and were given up; {len(scheduler.done)} others "
            "were finished and are kept. The same command tries them again; --partial reads the run without them"
        )
        for number, reason in scheduler.given_up.items():
            error.add_note(f"{self.plan.episodes[number].episode.episode_id}: {reason}")
        return error


def prepare(settings: ExtractSettings) -> Extraction:
    """Find the suite, load the model and plan the episodes.

    Raises what these raise: UnknownModelError, UnknownCategoryError, SuiteError, WeightsError …
    """
    if settings.workers or settings.ray:
        # This process only plans; the GPUs belong to the workers.
        planned = _load(replace(settings, device="cpu"))
        return replace(planned, settings=settings, controller=None)
    return _load(settings)


def load_worker(settings: ExtractSettings, run: str) -> Worker:
    """A worker for a run that exists, with a model of its own. Raises SettingsMismatchError if they differ."""
    extraction = _load(settings)
    assert extraction.controller is not None
    writer = RunWriter(locate(run), extraction.plan, extraction.identity())
    return Worker(writer, settings, extraction.controller, len(writer.remaining()))


def _load(settings: ExtractSettings) -> Extraction:
    if settings.model not in SCRIPTED:
        _find_family(settings.model)
    suite = _suite(settings)
    controller = _controller(settings, suite)
    with_tokens = settings.tokens == "all"
    plan = make_plan(suite, controller.streams, settings.seed, settings.captured_calls, with_tokens)
    return Extraction(settings, plan, controller.identity, controller)


def extract_run(settings: ExtractSettings, out: Path | str, progress: Progress | None = None) -> Run:
    """Extract a run to a folder or a URL such as `s3://bucket/prefix/run`, or continue the one that is there."""
    return prepare(settings).run(out, progress=progress)


def _find_family(name: str) -> None:
    """Refuse an unknown model before the suite is built."""
    from probe_kit.hooks.registry import find_family

    find_family(name, tuple(SCRIPTED))


def _suite(settings: ExtractSettings) -> Suite:
    if settings.suite is None:
        return default_suite().select(settings.categories, settings.items)
    return load_suite(settings.suite).select(settings.categories, settings.items)


def _controller(settings: ExtractSettings, suite: Suite) -> Controller:
    if settings.model in SCRIPTED:
        return ScriptedController(settings.model)
    from probe_kit.hooks import load_policy

    policy = load_policy(
        settings.model,
        settings.checkpoint,
        settings.device,
        settings.dtype,
        settings.random_weights,
        **settings.options,
    )
    instructions = sorted({item.instruction for item in suite.items})
    return PolicyController(
        policy, settings.model, instructions, settings.execute, settings.captured_calls, settings.tokens == "all"
    )
