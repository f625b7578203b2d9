"""A model's runs, sent to where they are played; the model is loaded once. Playing reports events."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING

from probe_kit.errors import DiskSpaceError, EpisodesFailedError, StoreError
from probe_kit.extract import prepare
from probe_kit.extract.extraction import Extraction
from probe_kit.extract.preparation import load_acting_policy, load_answer_model
from probe_kit.extract.rollout.controllers import SCRIPTED
from probe_kit.extract.settings import AskSettings, ExtractSettings, Settings
from probe_kit.study.ledger import Failure, Played, machine_name, now
from probe_kit.study.running.reuse import find_equal_run

if TYPE_CHECKING:
    from probe_kit.hooks import AnswerModel, Policy
    from probe_kit.runs import Run

STOPS_ALL = (DiskSpaceError, StoreError)
"""What is wrong with the place of all runs, and so stops the study."""


@dataclass(frozen=True)
class RunTask:
    """A run to be played or asked. run: as the plan names it. location: found from any working directory.

    done: episodes that were stored when the task was made.
    """

    run: str
    settings: Settings
    location: str
    done: int


@dataclass(frozen=True)
class ModelTask:
    """Runs of one model. gpus: that it needs. size: an estimate by which the longest task is found.

    reuse: folders of other runs, which serve where they are equal.
    """

    model: str
    runs: tuple[RunTask, ...]
    gpus: int = 0
    size: float = 0.0
    reuse: tuple[str, ...] = ()

    def without(self, runs: Sequence[str]) -> "ModelTask":
        """What is left once these runs are made or given up."""
        return replace(self, runs=tuple(one for one in self.runs if one.run not in runs))


@dataclass(frozen=True)
class Moved:
    """An episode of a run is stored. done, planned: episodes."""

    model: str
    run: str
    done: int
    planned: int
    outcome: str


@dataclass(frozen=True)
class Made:
    """A run is whole."""

    model: str
    run: str
    played: Played


Event = Moved | Made | Failure
Report = Callable[[Event], None]


def play_model(task: ModelTask, report: Report) -> None:
    """Load the model and make its runs one after another; what fails is reported, and committed episodes stay.

    Episodes that are given up end their run alone; anything else ends the model. Raises DiskSpaceError and
    StoreError, which concern all runs.
    """
    loaded = _Loaded()
    for one in task.runs:
        course = _Course(task, one, report)
        try:
            report(course.play(loaded))
        except STOPS_ALL:
            raise
        except EpisodesFailedError as error:
            some = bool(one.done or course.moved)
            report(Failure.of("episodes" if some else "playing", task.model, one.run, error))
            if not some:
                return
        except Exception as error:  # noqa: BLE001 - whatever a model raises must not end the others
            report(Failure.of("playing", task.model, one.run, error))
            return


@dataclass
class _Loaded:
    """The model as policy and as VLM, loaded on first use."""

    policy: "Policy | None" = None
    answer_model: "AnswerModel | None" = None

    def prepare(self, settings: Settings, location: str) -> Extraction:
        """An extraction with the model that is loaded."""
        if isinstance(settings, AskSettings):
            self.answer_model = self.answer_model or load_answer_model(settings)
            return prepare(settings, location, answer_model=self.answer_model)
        assert isinstance(settings, ExtractSettings)
        if settings.model.family not in SCRIPTED and self.policy is None:
            self.policy = load_acting_policy(settings)
        return prepare(settings, location, policy=self.policy)


@dataclass
class _Course:
    """The playing of one run. moved: episodes stored so far."""

    task: ModelTask
    one: RunTask
    report: Report
    moved: int = field(default=0)

    def play(self, loaded: _Loaded) -> Made:
        """Make or finish the run, or find an equal one."""
        extraction = loaded.prepare(self.one.settings, self.one.location)
        other = find_equal_run(extraction, self.task.reuse, self.one.location)
        if other is not None:
            return Made(self.task.model, self.one.run, played_by(other, served_by=other.location.address))
        began, clock = now(), perf_counter()
        run = extraction.run(self.one.location, progress=self._count)
        seconds = (perf_counter() - clock) / self.moved if self.moved else None
        played = played_by(run, began=began, ended=now(), seconds=seconds, machine=machine_name())
        return Made(self.task.model, self.one.run, played)

    def _count(self, done: int, planned: int, outcome: str) -> None:
        self.moved += 1
        self.report(Moved(self.task.model, self.one.run, done, planned, outcome))


def played_by(
    run: "Run", began: str = "", ended: str = "", seconds: float | None = None, machine: str = "",
    served_by: str = "",
) -> Played:  # fmt: skip
    """What the ledger says of a run."""
    return Played(
        episodes=len(run.episodes),
        settings_sha256=run.settings_sha256,
        weights_sha256=run.weights_sha256,
        provenance=[dict(one) for one in run.provenances.values()],
        began=began,
        ended=ended,
        seconds=None if seconds is None else round(seconds, 4),
        machine=machine,
        stamp=run.stamp,
        served_by=served_by,
    )
