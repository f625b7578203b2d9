"""How fast the models of a study are here: a few episodes of each, played into a folder that is removed."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Literal

from probe_kit.errors import ProbeKitError
from probe_kit.extract.settings import ExtractSettings, Settings
from probe_kit.runs import open_run
from probe_kit.study.cells import Cell
from probe_kit.study.ledger import Failure, Ledger, Speed, now
from probe_kit.study.planning.cost import bytes_per_episode, speed_name, units
from probe_kit.study.planning.plan import PlannedCell, StudyPlan
from probe_kit.study.running.model_task import Event, ModelTask, Moved, RunTask, play_model

EPISODES = 8
"""Least number of episodes: with fewer, extraction starts no processes that simulate."""
INFERENCES = 20
"""Most of a policy in one episode."""


def calibrate_study(
    plan: StudyPlan, begin: Callable[[str], None] | None = None, env_workers: int | None = None
) -> list[Failure]:
    """Measure each model that has missing episodes and no rate; the ledger keeps the rates of this machine.

    A model is loaded and plays some short episodes. The time to set up an episode then weighs more than in a long
    one, so that hours are rather too many. begin: called with the name of each model. Returns the models that
    failed, which the ledger does not note.
    """
    ledger, failures, seen = Ledger(plan.study.study.folder), list[Failure](), set[str]()
    for one in plan.played:
        name = speed_name(one.cell)
        if not one.missing or one.cell.name in plan.cost.seconds or name in seen:
            continue
        seen.add(name)
        if begin is not None:
            begin(name)
        found = _measured(one, env_workers)
        if isinstance(found, Failure):
            failures.append(found)
        else:
            ledger.note_speed(name, found)
    return failures


def _measured(one: PlannedCell, env_workers: int | None) -> Speed | Failure:
    cell, watch = one.cell, _Watch()
    settings = _shortened(cell).changed(env_workers=env_workers)
    with TemporaryDirectory(prefix="probe-kit-calibration-") as folder:
        place = Path(folder) / "run"
        try:
            play_model(ModelTask(cell.model, (RunTask(cell.name, settings, str(place), 0),)), watch)
        except ProbeKitError as error:
            return Failure.of("playing", cell.model, cell.name, error)
        if watch.failure is not None:
            return watch.failure
        streams = list(open_run(place).root.streams.values())
    return Speed(
        seconds=round(watch.pace(settings.machine.observations) / units(replace(cell, settings=settings)), 6),
        bytes=bytes_per_episode(streams, cell.settings),
        batch=settings.machine.observations,
        device=settings.machine.device,
        tokens=settings.capture.tokens,
        episodes=len(watch.times),
        when=now(),
    )


def _shortened(cell: Cell) -> Settings:
    """The settings of a cell with few episodes, each of few inferences, which are captured where several are."""
    settings = cell.settings_to_play
    name, count = max(cell.selection.counts(cell.suite).items(), key=lambda pair: pair[1])
    items = min(count, max(EPISODES // 2, 2 * settings.machine.observations))
    settings = settings.changed(categories=(name,), items=items - items % 2)
    if not isinstance(settings, ExtractSettings):
        return settings
    steps = min(settings.scene.max_steps, INFERENCES * (settings.task.execute or 1))
    calls: int | Literal["all"] = 1 if settings.capture.captured_calls == 1 else "all"
    return settings.changed(max_steps=steps, captured_calls=calls)


class _Watch:
    """Times of episodes, and what failed."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.failure: Failure | None = None

    def __call__(self, event: Event) -> None:
        if isinstance(event, Moved):
            self.times.append(perf_counter())
        elif isinstance(event, Failure):
            self.failure = event

    def pace(self, batch: int) -> float:
        """Seconds per episode after the first batch, before which processes started."""
        first = min(batch, len(self.times) - 1)
        return (self.times[-1] - self.times[first - 1]) / (len(self.times) - first)
