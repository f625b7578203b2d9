"""Playing of a study in this process: one model after the other, each loaded once for all of its runs."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from probe_kit.errors import DiskSpaceError, ProbeKitError, StoreError
from probe_kit.extract import prepare
from probe_kit.extract.prepared import as_protocol, check_run, load_acting_policy, load_answer_model
from probe_kit.extract.rollout.controllers import SCRIPTED
from probe_kit.extract.settings import AskSettings, ExtractSettings
from probe_kit.extract.store.locations.locate import locate
from probe_kit.study.plan import PlannedCell, StudyPlan, cells_by_model

if TYPE_CHECKING:
    from probe_kit.extract import Run

_STOP = (DiskSpaceError, StoreError)
"""What is wrong with the place of all runs, and so stops the study."""
Progress = Callable[[PlannedCell, int, int, str], None]


@dataclass(frozen=True)
class ModelFailure:
    """A model whose runs could not be made. run: the one at which it failed, such as `base/plain`."""

    model: str
    run: str
    reason: str

    def __str__(self) -> str:
        return f"{self.model} failed at {self.run}: {self.reason}"


def conduct_study(
    plan: StudyPlan,
    progress: Progress | None = None,
    failed: Callable[[ModelFailure], None] | None = None,
    env_workers: int | None = None,
) -> list[ModelFailure]:
    """Play and ask all that a plan finds missing; returns the models that failed.

    Every run is checked before the first one is played. A model that fails stops itself alone: episodes that are
    committed stay, and the next call resumes after them. progress: called per episode with the run, episodes done
    and planned, and the outcome. failed: called when a model fails. env_workers: processes that simulate, as in
    `ExtractSettings`.
    Raises DiskSpaceError, StoreError, and whatever stops a single extraction that is no error of probe_kit.
    """
    failures: dict[str, ModelFailure] = {}

    def give_up(one: PlannedCell, error: ProbeKitError) -> None:
        failures[one.cell.model] = ModelFailure(one.cell.model, one.cell.name, str(error))
        if failed is not None:
            failed(failures[one.cell.model])

    missing = [one for one in plan.played if one.state == "damaged" or one.missing]
    for one in missing:
        if one.cell.model not in failures and (error := _problem(one)) is not None:
            give_up(one, error)
    for model, cells in cells_by_model(missing).items():
        if model not in failures:
            _play_model(cells, progress, give_up, env_workers)
    return list(failures.values())


def _problem(one: PlannedCell) -> ProbeKitError | None:
    """What is wrong with a run as far as it shows without scene and model."""
    if one.state == "damaged":
        return ProbeKitError(one.why.removeprefix("damaged: "))
    try:
        check_run(as_protocol(one.cell.settings_to_play), locate(one.location))
    except _STOP:
        raise
    except ProbeKitError as error:
        return error
    return None


def _play_model(
    cells: list[PlannedCell],
    progress: Progress | None,
    give_up: Callable[[PlannedCell, ProbeKitError], None],
    env_workers: int | None,
) -> None:
    loaded: dict[str, Any] = {}
    for one in cells:
        try:
            _play(one, loaded, progress, env_workers)
        except _STOP:
            raise
        except ProbeKitError as error:
            give_up(one, error)
            return


def _play(one: PlannedCell, loaded: dict[str, Any], progress: Progress | None, env_workers: int | None) -> "Run":
    """Make or finish one run. loaded: the model as policy and as VLM, filled on first use."""
    settings = replace(one.cell.settings_to_play, env_workers=env_workers)
    if isinstance(settings, AskSettings) and "answer_model" not in loaded:
        loaded["answer_model"] = load_answer_model(settings)
    if isinstance(settings, ExtractSettings) and settings.model not in SCRIPTED and "policy" not in loaded:
        loaded["policy"] = load_acting_policy(settings)
    if isinstance(settings, AskSettings):
        extraction = prepare(settings, one.location, answer_model=loaded["answer_model"])
    else:
        extraction = prepare(settings, one.location, policy=loaded.get("policy"))

    def tell(done: int, planned: int, outcome: str) -> None:
        if progress is not None:
            progress(one, done, planned, outcome)

    return extraction.run(one.location, progress=tell)
