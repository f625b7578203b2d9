"""Preparation of an extraction: finds the suite, loads the model, plans the episodes. Writes nothing."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from probe_kit.errors import UsageError
from probe_kit.extract.calibration import Calibration, calibrated
from probe_kit.extract.early import asked_objects, check_model, check_place, check_words, check_writable
from probe_kit.extract.needs import PlannedSizes, planned_sizes
from probe_kit.extract.plan import (
    Plan,
    PlannedEpisode,
    RowPlan,
    instructions_of,
    make_plan,
    plan_episodes,
    skipped_items,
)
from probe_kit.extract.recordings.early_fit import check_state_width, declared_inputs, raise_together
from probe_kit.extract.recordings.lerobot_folder import fetched, open_lerobot
from probe_kit.extract.recordings.recorded_plan import RecordedPlan, Recording
from probe_kit.extract.rollout.answer_controller import AnswerController
from probe_kit.extract.rollout.controllers import SCRIPTED, ActingController, PolicyController, ScriptedController
from probe_kit.extract.rollout.examples import check_unfit, example_observations
from probe_kit.extract.rollout.own_environments.environment_controller import (
    OpenedEnvironment,
    environment_controller,
    environment_plan,
    fit_environment,
)
from probe_kit.extract.rollout.preflight import (
    FIRST_EPISODES,
    check_units,
    first_states,
    run_preflight,
    unusual_shares,
)
from probe_kit.extract.rollout.recorded.recorded_controller import check_recorded_units, fit, recorded_controller
from probe_kit.extract.rollout.recorded.recorded_stage import example_of
from probe_kit.extract.rollout.settings_checks import (
    check_embodiment,
    check_meaningless,
    check_misfit,
    check_unreachable,
)
from probe_kit.extract.settings import AskSettings, ExtractSettings, Settings, run_label
from probe_kit.extract.sources.environment import EnvSource
from probe_kit.extract.sources.recording import LeRobotSource
from probe_kit.extract.sources.scene import SceneSettings
from probe_kit.extract.vqa.phrases import phrases
from probe_kit.hashing import sha256_json
from probe_kit.runs.layout import RUN_FILE, StoredStream
from probe_kit.runs.location import Location
from probe_kit.runs.provenance import provenance_here
from probe_kit.runs.writer import RunWriter
from probe_kit.suite import Suite, default_suite, load_suite
from probe_kit.suite.build import ITEMS, default_folder
from probe_kit.suite.validation.sufficiency import Smallest

if TYPE_CHECKING:
    from probe_kit.hooks import AnswerModel, Policy


@dataclass(frozen=True)
class Prepared:
    """What an extraction starts from: the model was loaded and the plan is made.

    controller: None if the model is loaded again by workers elsewhere. calibration: what chose the batch, None if
    it was not requested or is left to workers. declared: whose sizes the streams have where no model
    was loaded and the run has no name yet; empty where one was.
    """

    settings: Settings
    plan: RowPlan
    card: dict[str, Any]
    controller: ActingController | AnswerController | None
    calibration: Calibration | None = None
    declared: str = ""

    def identity(self) -> dict[str, Any]:
        """Everything that decides the numbers of an episode: neither which are selected, nor the label.

        Runs with equal identity have equal numbers in the episodes that both have.
        """
        return {
            **self.settings.identity(),
            **self.card,
            **self.plan.identity,
            **({"scene": self.settings.scene.to_json()} if isinstance(self.plan, Plan) else {}),
        }

    def provenance(self) -> dict[str, Any]:
        """That of a process that plays with these settings here; with the decoder of recorded videos."""
        dtype: str | None = self.card.get("dtype")
        decoder = {} if self.plan.decoder is None else {"decoder": self.plan.decoder}
        return provenance_here(self.settings.machine.device, dtype) | decoder

    def writer(self, location: Location) -> RunWriter[RowPlan]:
        """A writer of the run at `location`, which it begins or continues.

        Raises SettingsMismatchError if other settings are there.
        """
        return RunWriter(location, self.plan, self.identity(), self.provenance(), run_label(self.settings))

    def default_name(self) -> str:
        """Folder name that repeats for the same settings, so that the same command finds its run again.

        A command with more items finds it too; one with other categories, wordings or another suite does not.
        """
        named = [self.identity(), *self.plan.name_parts, self.settings.wordings]
        # Without the weights' hash there is no name yet.
        name = [self.settings.model.family, "…" if self.declared else sha256_json(named)[:8]]
        if isinstance(self.settings, AskSettings):
            name = ["ask", name[0], self.settings.short_name, name[1]]
        return "-".join(name)


def load(
    settings: Settings,
    rehearsed: bool = False,
    location: Location | None = None,
    answer_model: "AnswerModel | None" = None,
    policy: "Policy | None" = None,
    fetch: bool = True,
) -> Prepared:
    """Find the suite, build the scene once unless that was done, load the model and plan the episodes.

    location: where it will be written, if that is known, so that it is looked at before the model is loaded.
    answer_model: the model of these `AskSettings`, if it is loaded already; it may be one of your own.
    policy: the model of these `ExtractSettings`, if it is loaded already; several runs then share it.
    fetch: False makes the plan of the streams that the model's family declares: without weights, network or GPU. A
    family that declares none is loaded.
    Raises UsageError for a policy of another family or with other weights than the settings name, and what these
    raise: UnknownModelError, UnknownCategoryError, SuiteError, WeightsError …
    """
    settings = as_protocol(settings)
    if isinstance(settings, ExtractSettings) and isinstance(settings.source, LeRobotSource | EnvSource):
        return _load_source(settings, settings.source, location, policy, fetch)
    suite = check_run(settings, location, loaded=not (answer_model is None and policy is None), fetch=fetch)
    if not rehearsed:
        run_preflight(settings.scene, plan_episodes(suite, settings.seed))
    wordings, objects = settings.wordings, asked_objects(settings, suite)
    asked = list(plan_episodes(suite, settings.seed, wordings, objects))
    if wordings is not None:
        skipped_items(suite, asked, wordings)
    if policy is None:
        _check_instructions(settings, instructions_of(asked), fetch)
    if not fetch and (sizes := planned_sizes(settings, instructions_of(asked))) is not None:
        settings = _planned_settings(settings, sizes)
        plan = _plan(suite, list(sizes.streams), settings, objects)
        return Prepared(settings, plan, _declared_card(settings), None, declared=sizes.source)
    if isinstance(settings, AskSettings):
        controller: ActingController | AnswerController = _asking(settings, suite, answer_model)
    else:
        controller = _acting(settings, instructions_of(asked), policy)
        if isinstance(controller, PolicyController) and isinstance(settings, ExtractSettings):
            _check_scene_units(settings, asked, controller.policy)
    if isinstance(settings, ExtractSettings) and isinstance(controller, PolicyController):
        settings = settings.with_every_call(controller.execute)
    plan = _plan(suite, controller.streams, settings, objects)
    if (
        isinstance(settings, ExtractSettings)
        and isinstance(controller, PolicyController)
        and settings.machine.batch == "auto"
    ):
        settings, calibration = calibrated(settings, controller, plan)
        return Prepared(settings, plan, controller.identity, controller, calibration)
    return Prepared(settings, plan, controller.identity, controller)


def _plan(suite: Suite, streams: list[StoredStream], settings: Settings, objects: Mapping[str, str]) -> Plan:
    return make_plan(
        suite, streams, settings.seed, settings.capture.calls, settings.capture.tokens == "all", settings.wordings,
        objects, settings.capture.later_views,
    )  # fmt: skip


def as_protocol(settings: Settings) -> Settings:
    """The settings with what their protocol or recording decides; see `ExtractSettings.followed`."""
    if not isinstance(settings, ExtractSettings):
        return settings
    if isinstance(settings.source, EnvSource):
        check_meaningless(settings)
        return settings
    if isinstance(settings.source, LeRobotSource):
        return _with_recording(settings, settings.source)
    return settings.followed()


def _with_recording(settings: ExtractSettings, source: LeRobotSource) -> ExtractSettings:
    """The settings of a run on recordings: every frame of a row is captured, nothing acts, no thumbnails are kept.

    A revision of the hub becomes its commit. Raises what `open_lerobot` raises.
    """
    check_meaningless(settings)
    folder = open_lerobot(source)
    if folder.repo is not None:
        source = source.changed(folder=f"{folder.repo}@{folder.revision}")
    calls = Recording.of(folder, source).most_frames
    return settings.changed(source=source, captured_calls=calls, capture_only=True, frames="none")


def _load_source(
    settings: ExtractSettings,
    source: LeRobotSource | EnvSource,
    location: Location | None,
    loaded: "Policy | None",
    fetch: bool,
) -> Prepared:
    """As `load`, of recordings or of an environment of the user's own."""
    if loaded is None:
        check_model(settings, tuple(SCRIPTED), fetch)
    if location is not None:
        check_writable(location)
    opened = OpenedEnvironment.of(source) if isinstance(source, EnvSource) else open_recording(source)
    if loaded is None:
        raise_together(_before_loading(settings, opened, fetch))
    if not fetch and (sizes := planned_sizes(settings, opened.instructions)) is not None:
        streams = list(sizes.streams)
        if isinstance(opened, OpenedEnvironment):
            execute = settings.task.execute or sizes.execute
            settings = settings.with_every_call(execute)
            planned: RowPlan = environment_plan(opened, None, streams, settings, execute)
        else:
            planned = recorded_plan(opened, streams, settings, (0, 0))
        return Prepared(settings, planned, _declared_card(settings), None, declared=sizes.source)
    if loaded is not None:
        _check_loaded(settings, loaded)
    policy = load_acting_policy(settings) if loaded is None else loaded
    if isinstance(opened, OpenedEnvironment):
        return _prepared_environment(settings, opened, policy)
    return _prepared_recording(settings, opened, policy)


def _before_loading(
    settings: ExtractSettings, opened: "OpenedEnvironment | Recording", fetch: bool
) -> list[Callable[[], object]]:
    """Checks of words, and of cameras and state where the checkpoint's files declare them."""
    from probe_kit.hooks.registry import get_family

    instructions, family = opened.instructions, get_family(settings.model.family)
    checks: list[Callable[[], object]] = [
        lambda: check_words(settings, instructions, tuple(SCRIPTED)),
        lambda: _check_instructions(settings, instructions, fetch),
    ]
    if family is None or not isinstance(opened, Recording):
        return checks
    declared = declared_inputs(family, settings.model.checkpoint, settings.model.options)
    if declared is None:
        return checks
    cameras, state = declared
    named = settings.model.checkpoint or settings.model.family
    return [
        lambda: opened.mapped(cameras),
        *checks,
        lambda: check_state_width(opened, named, state),
    ]


def _prepared_environment(settings: ExtractSettings, opened: OpenedEnvironment, policy: "Policy") -> Prepared:
    fitted = fit_environment(opened, policy)
    names = [str(place) for place in range(fitted.example.state.size)]
    where = f"{opened.source.name}, the state after reset()"
    check_units(fitted.unusual, names, where, fitted.policy, settings.machine.accept_units)
    controller = environment_controller(fitted, settings)
    settings = settings.with_every_call(controller.execute)
    check_unfit(fitted.policy.card, settings.machine.observations, fitted.example)
    check_unreachable(settings, fitted.policy.card)
    planned = environment_plan(opened, fitted, controller.streams, settings, controller.execute)
    return Prepared(settings, planned, controller.identity, controller)


def _prepared_recording(settings: ExtractSettings, recording: Recording, policy: "Policy") -> Prepared:
    fitted = fit(recording, policy)
    check_recorded_units(fitted, settings.machine.accept_units)
    settings = settings.changed(source=fitted.recording.source)
    controller = recorded_controller(fitted, settings)
    check_unfit(
        fitted.policy.card, settings.machine.observations, example_of(fitted.recording, recording.instructions[0])
    )
    planned = recorded_plan(fitted.recording, controller.streams, settings, fitted.prediction)
    planned = replace(planned, other_actions=fitted.other_actions)
    return Prepared(settings, planned, controller.identity, controller)


def check_recording(settings: ExtractSettings, recording: Recording) -> None:
    """Raise as `load` what a model, its options and its words say of a recording before weights are loaded."""
    check_model(settings, tuple(SCRIPTED))
    check_meaningless(settings)
    check_words(settings, recording.instructions, tuple(SCRIPTED))
    _check_instructions(settings, recording.instructions, fetch=True)


def open_recording(source: LeRobotSource) -> Recording:
    """What `source` chooses, with the numbers of the chosen episodes here. Raises as `open_lerobot`."""
    recording = Recording.of(open_lerobot(source), source)
    fetched(recording.folder, recording.episodes, ())
    recording.folder.check_files(recording.episodes, ())
    return recording


def recorded_plan(
    recording: Recording, streams: Sequence[StoredStream], settings: ExtractSettings, prediction: tuple[int, int]
) -> RecordedPlan:
    """The rows of a recording. prediction: (chunk, D) of the model."""
    rows = tuple(recording.stretches(settings.seed))
    per_call = sum(stream.raw_bytes(settings.capture.tokens == "all") for stream in streams)
    size = per_call * settings.capture.calls * len(rows)
    return RecordedPlan(
        rows, tuple(streams), size, recording.dataset(prediction), recording.source.name,
        len(recording.folder.lengths),
    )  # fmt: skip


def check_run(
    settings: Settings, location: Location | None = None, loaded: bool = False, fetch: bool = True
) -> Suite:
    """The suite of a run, once everything was checked that can be without scene and model. Raises as `load`.

    loaded: the model is there already, and may be one that no name leads to. fetch: see `Family.check`.
    """
    if not loaded:
        check_model(settings, tuple(SCRIPTED), fetch)
    check_meaningless(settings)
    suite = _suite(settings, not fetch and _is_only_planned(settings, location))
    texts = _texts(settings, suite)
    if not loaded:
        check_words(settings, texts, tuple(SCRIPTED))
    if location is not None:
        check_place(settings, suite, location)
    return suite


def _check_instructions(settings: Settings, instructions: Sequence[str], fetch: bool) -> None:
    """Raise InstructionError for what a policy cannot read, and UsageError for units that have to be chosen.

    Before its network is loaded.
    """
    from probe_kit.hooks.registry import get_family

    family = get_family(settings.model.family)
    if family is not None and isinstance(settings, ExtractSettings):
        family.whose_units(settings.model.checkpoint, settings.model.options, fetch)
        family.check_instructions(settings.model.checkpoint, instructions, settings.model.options, fetch)


def _planned_settings(settings: Settings, sizes: PlannedSizes) -> Settings:
    """The settings with the inferences of an episode counted. Raises CheckpointError for who cannot act."""
    if not isinstance(settings, ExtractSettings):
        return settings
    if isinstance(settings.source, SceneSettings) and sizes.outline is not None:
        check_misfit(settings, sizes.outline.misfit(), sizes.outline.checkpoint)
    return settings.with_every_call(settings.task.execute or sizes.execute)


def _declared_card(settings: Settings) -> dict[str, Any]:
    """What is known of a model that was not loaded."""
    execute = settings.task.execute if isinstance(settings, ExtractSettings) else None
    given = {"dtype": settings.model.dtype, "execute": execute}
    known = {name: value for name, value in given.items() if value is not None}
    return {
        "model": settings.model.family,
        "random_weights": settings.model.random_weights,
        "weights_sha256": None,
        **known,
    }


def _is_only_planned(settings: Settings, location: Location | None) -> bool:
    """Whether nothing but the items themselves is asked of the suite.

    Names of runs that are known before they are played hold the hash of the whole suite, and so does a run that is
    there; questions name objects of all its items.
    """
    if not isinstance(settings, ExtractSettings):
        return False
    from probe_kit.hooks.registry import get_family

    family = get_family(settings.model.family)
    if location is None:
        return family is not None and bool(family.declared)
    with location.in_words():
        return not location.exists(RUN_FILE)


def _suite(settings: Settings, planned: bool = False) -> Suite:
    """The suite of these settings. planned: its first items alone are needed."""
    source = settings.source
    assert isinstance(source, SceneSettings)
    if source.suite is None:
        # Of a category drawn alone every item is the same: drawing all eleven takes minutes.
        if planned and source.items is not None and not default_folder(source.categories).is_dir():
            return _first_items(source.categories, source.items)
        return default_suite(source.categories).select(None, source.items)
    return load_suite(source.suite).select(source.categories, source.items)


def _first_items(categories: Sequence[str] | None, count: int) -> Suite:
    """The first items of the embedded suite, drawn alone: fewer items are the beginning of more.

    It is said to be selected from the category that a plan looks at for further items, which is drawn in full.
    """
    drawn = min(max(2, count + count % 2), ITEMS)
    suite = default_suite(categories, drawn).select(None, count)
    return replace(suite, selected_from=default_suite((Smallest.of(suite).category,)))


def _texts(settings: Settings, suite: Suite) -> tuple[str, ...]:
    """What the model will read: instructions, or the objects of questions."""
    if not isinstance(settings, AskSettings):
        return instructions_of(plan_episodes(suite, settings.seed, settings.wordings))
    return tuple(
        dict.fromkeys(phrase.text for phrase in phrases(suite, settings.task.query, settings.seed).values())
    )


def _asking(settings: AskSettings, suite: Suite, answer_model: "AnswerModel | None") -> AnswerController:
    blank = example_observations(settings.scene, [min(item.instruction for item in suite.items)])[0]
    model = load_answer_model(settings) if answer_model is None else answer_model
    check_unfit(model.card, settings.machine.observations, blank)
    return AnswerController(model, settings, suite, blank)


def load_answer_model(settings: AskSettings) -> "AnswerModel":
    """The model that is asked. Raises UsageError if it answers no questions, and what `load_model` raises."""
    from probe_kit.hooks import AnswerModel, load_model

    model = load_model(
        settings.model.family,
        settings.model.checkpoint,
        settings.machine.device,
        settings.model.dtype,
        settings.model.random_weights,
        settings.model.weights_seed,
        **settings.model.options,
    )
    if not isinstance(model, AnswerModel):
        raise UsageError(
            f"{settings.model.family} returned a {type(model).__name__}, not a AnswerModel; fix the loader"
        )
    return model


def _acting(settings: Settings, instructions: Sequence[str], loaded: "Policy | None") -> ActingController:
    assert isinstance(settings, ExtractSettings)
    if settings.model.family in SCRIPTED:
        return ScriptedController(settings.model.family)
    if loaded is not None:
        _check_loaded(settings, loaded)
    policy = load_acting_policy(settings) if loaded is None else loaded
    examples = example_observations(settings.scene, instructions)
    check_embodiment(settings, policy)
    check_unfit(policy.card, settings.machine.observations, examples[0])
    check_unreachable(settings, policy.card)
    return PolicyController(
        policy,
        settings.model.family,
        examples,
        settings.task.execute,
        settings.with_every_call(settings.task.execute or policy.card.execute).capture.calls,
        settings.capture.tokens == "all",
        settings.task.edits,
        settings.task.vectors,
        settings.task.capture_only,
        settings.machine.inference_limit,
        settings.task.rotation,
    )


def _check_scene_units(settings: ExtractSettings, asked: Sequence[PlannedEpisode], policy: "Policy") -> None:
    """Raise UnitsError for a scene whose first states lie outside the statistics of a policy that reads them."""
    if settings.machine.accept_units or policy.state_numbers is None or "state" in policy.zero_filled_inputs():
        return
    states = policy.laid_out(first_states(settings.scene, asked[:FIRST_EPISODES]))
    names = [str(place) for place in range(states.shape[1])]
    check_units(unusual_shares(policy, states), names, f"the scene {settings.scene.name}", policy, False)


def load_acting_policy(settings: ExtractSettings) -> "Policy":
    """The policy that acts, with what its protocol decides. Raises what `load_policy` raises."""
    from probe_kit.hooks import load_policy

    chosen = settings.followed()
    return load_policy(
        chosen.model.family,
        chosen.model.checkpoint,
        chosen.machine.device,
        chosen.model.dtype,
        chosen.model.random_weights,
        chosen.model.weights_seed,
        **chosen.model.options,
    )


def _check_loaded(settings: ExtractSettings, policy: "Policy") -> None:
    """Raise UsageError for a loaded policy that the settings do not describe."""
    from probe_kit.hooks.registry import family_names

    card = policy.card
    said: dict[str, tuple[object, object]] = {}
    # A file may call its weights random; requested random weights have a seed.
    if settings.model.random_weights or card.weights_seed is not None:
        said["random_weights"] = settings.model.random_weights, card.random_weights
    if card.weights_seed is not None:
        said["weights_seed"] = settings.model.weights_seed, card.weights_seed
    if card.family in family_names():
        said["model"] = settings.model.family, card.family
    wrong = [f"{name} {there!r} instead of {asked!r}" for name, (asked, there) in said.items() if asked != there]
    if wrong:
        raise UsageError(
            f"the loaded policy has {', '.join(wrong)}. Give the policy of these settings, or leave it out"
        )
