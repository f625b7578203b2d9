"""Tasks: what a model does with the observations of a source. It acts, is only captured, or answers questions.

A task knows no particular source and has no state: all choices are in the settings, see `states.py`.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.extract.parts import SCRIPTED
from probe_kit.extract.prompts import phrases
from probe_kit.extract.rollout.answer_controller import AnswerController
from probe_kit.extract.rollout.calibration import Calibration, calibrate
from probe_kit.extract.rollout.controllers import Controller, PolicyController, ScriptedController
from probe_kit.extract.settings import AskSettings, ExtractSettings, Settings
from probe_kit.extract.sizes import PlannedSizes
from probe_kit.extract.sources.source import Source
from probe_kit.extract.states import Decided, Fitted, count_calls
from probe_kit.hooks.checkpoints.third_party import with_origin
from probe_kit.runs.plan import Row

if TYPE_CHECKING:
    from probe_kit.hooks import AnswerModel, Model, Policy
    from probe_kit.hooks.contract.card import DeclaredInputs, ModelCard
    from probe_kit.hooks.family import Family


@dataclass(frozen=True)
class LoadedModel:
    """A model that is loaded in this process, with what this machine decides.

    Attributes:
        controller: The controller of the model.
        observations: The number of observations per call of the model.
        calibration: The measurement that chose it; None if it was not requested.
    """

    controller: Controller
    observations: int
    calibration: Calibration | None = None


def task_of(settings: Settings) -> "Task[Any, Any]":
    """Return the task of some settings: an `Act` or an `Ask`, whose methods take settings of their own class."""
    return Ask() if settings.asks else Act()


def load_of[Loaded: "Model"](load_by_name: Callable[..., Loaded], settings: Settings) -> Loaded:
    """Load a model by its name as the settings say. Errors are those of `load_by_name`."""
    model = settings.model
    return load_by_name(
        model.family,
        model.checkpoint,
        settings.machine.device,
        model.dtype,
        model.random_weights,
        model.weights_seed,
        **model.options,
    )


def fit_source[Chosen: Settings](
    card: "ModelCard", decided: Decided[Chosen], source: Source[Any]
) -> Decided[Chosen]:
    """Return the settings with those of a source that was fitted to a model.

    Raises:
        UsageError: If the model takes smaller batches, or needs what the source does not show.
    """
    settings = decided.settings
    # `auto` is measured after this check, and by `largest_batch` never exceeds the card.
    batch = settings.machine.batch if isinstance(settings.machine.batch, int) else 1
    if card.batch is not None and batch > card.batch:
        raise UsageError(
            f"--batch {batch} with {card.family}, which takes at most {card.batch} observations per call: more "
            f"would change its numbers; pass --batch {card.batch} and use --workers to go faster"
        )
    if lacking := source.example(source.instructions[0]).lacks(card.needs):
        raise UsageError(
            f"{card.family} reads {', '.join(lacking)}, which {settings.source.subject} do not show; observations "
            "have pictures and the state, in a scene also the intrinsics"
        )
    if source.settings == settings.source:
        return decided
    return replace(decided, settings=settings.changed(source=source.settings))


_SCRIPT_REFUSES = (
    "capture_only", "checkpoint", "random_weights", "batch", "execute", "rotation", "dtype", "tokens=all",
    "captured_calls", "options",
)  # fmt: skip
_CAPTURE_REFUSES = ("captured_calls", "execute", "rotation", "video")


class Task[Chosen: Settings, Loaded: "Model"](Protocol):
    """The steps of an extraction that depend on the task, in the order in which an extraction takes them.

    Every check raises UsageError, and what its own docstring says.

    Attributes:
        names_all_items: Whether it needs the whole suite besides the chosen items, for the names of other objects.
    """

    names_all_items: ClassVar[bool]

    def check_meaningless(self, settings: Chosen) -> None:
        """Check settings by themselves, before anything is opened."""

    def check_family(self, settings: Chosen, family: "Family | None") -> None:
        """Check a family that is not loaded; None for a script."""

    def view_of(self, source: Source[Any]) -> Source[Any]:
        """Return the source as the task goes through it."""

    def texts(self, settings: Chosen, source: Source[Any]) -> Iterable[str]:
        """Return the texts that the model must be able to read."""

    def rows(self, settings: Chosen, source: Source[Any]) -> tuple[Row, ...]:
        """Return the rows that are played."""

    def check_loaded(self, decided: Decided[Chosen], model: Loaded) -> None:
        """Check a model that the caller loaded."""

    def early_checks(
        self, decided: Decided[Chosen], source: Source[Any], fetch: bool
    ) -> list[Callable[[], object]]:
        """Return the checks of a model by its small files, before its weights are read."""

    def declared_inputs(self, decided: Decided[Chosen]) -> "DeclaredInputs | None":
        """Return the inputs that the files of the model declare; None where they declare none."""

    def planned(self, decided: Decided[Chosen], sizes: PlannedSizes) -> Fitted[Chosen]:
        """Return the settings with what sizes decide, for a plan."""

    def load(self, settings: Chosen) -> "Loaded | None":
        """Load the model; None for a script."""

    def fit(
        self, decided: Decided[Chosen], source: Source[Any], model: "Loaded | None"
    ) -> tuple[Fitted[Chosen], Source[Any], LoadedModel]:
        """Fit source and model to each other; return the source as the model is shown it."""


class Act:
    """The task in which a policy acts, or is captured once per row; a script acts and has no activations."""

    names_all_items: ClassVar[bool] = False

    def view_of(self, source: Source[Any]) -> Source[Any]:
        """Return the source as it is."""
        return source

    def rows(self, settings: ExtractSettings, source: Source[Any]) -> tuple[Row, ...]:
        """Return the rows of the source."""
        return source.rows(settings.seed)

    def check_meaningless(self, settings: ExtractSettings) -> None:
        """Raise UsageError for settings that a script, or a policy that does not act, has no use for."""
        name, source = settings.model.family, settings.source
        if name in SCRIPTED and not source.is_scene:
            raise UsageError(f"{name} is scripted and looks at nothing; choose a model with weights")
        if settings.task.capture_only and source.is_scene:
            why = "which captures one inference per episode and executes no action; remove it"
            settings.refuse(_CAPTURE_REFUSES, f"does not apply with --no-act, {why}")
        if name in SCRIPTED:
            why = f"{name} is scripted and has no network. Remove it, or choose a model with weights"
            settings.refuse(_SCRIPT_REFUSES, f"does not apply: {why}")

    def check_family(self, settings: ExtractSettings, family: "Family | None") -> None:
        """Raise UsageError for a model that answers, and in a scene the errors of `Family.check_acting`."""
        if family is None:
            return
        if not family.abilities.acts:
            raise UsageError(f"{family.name} answers and does not act; use `probe-kit ask`, or a model that acts")
        if settings.source.is_scene and not settings.task.capture_only:
            family.check_acting(settings.model.checkpoint, settings.model.options)

    def texts(self, settings: ExtractSettings, source: Source[Any]) -> Iterable[str]:
        """Return the instructions of a scene; those of other sources are checked with cameras and state."""
        return source.instructions if settings.source.is_scene else ()

    def early_checks(
        self, decided: Decided[ExtractSettings], source: Source[Any], fetch: bool
    ) -> list[Callable[[], object]]:
        """Return checks of instructions, of units that have to be chosen, and of cameras and states."""
        from probe_kit.hooks.registry import get_family

        settings = decided.settings
        model, family = settings.model, get_family(settings.model.family)
        if family is None:
            return []

        def check_instructions() -> None:
            if not settings.source.is_scene:
                family.check_words(source.instructions, model.checkpoint)
            family.whose_units(model.checkpoint, model.options, fetch)
            family.check_instructions(model.checkpoint, source.instructions, model.options, fetch)

        inputs = _declared_inputs(family, settings)
        checkpoint = model.checkpoint or model.family
        return [check_instructions, *(() if inputs is None else source.early_checks(inputs, checkpoint))]

    def declared_inputs(self, decided: Decided[ExtractSettings]) -> "DeclaredInputs | None":
        """Return the inputs of a checkpoint in lerobot's layout, else those of the model without its weights."""
        from probe_kit.hooks.registry import get_family

        settings = decided.settings
        model, family = settings.model, get_family(settings.model.family)
        if family is None:
            return None
        if (inputs := _declared_inputs(family, settings)) is not None:
            return inputs
        outline = family.outline(model.checkpoint, model.options, model.dtype)
        return None if outline is None or outline.model is None else outline.model.card.inputs()

    def planned(self, decided: Decided[ExtractSettings], sizes: PlannedSizes) -> Fitted[ExtractSettings]:
        """Return the settings with the inferences of an episode counted."""
        settings = decided.settings
        # Only a scene has an arm that actions could misfit.
        if settings.source.is_scene and sizes.outline is not None:
            check_misfit(settings, sizes.outline.misfit(), sizes.outline.checkpoint)
        return count_calls(settings, settings.task.execute or sizes.execute)

    def load(self, settings: ExtractSettings) -> "Policy | None":
        """Load the policy, with what its protocol decides. Raises as `load_policy`."""
        from probe_kit.hooks import load_policy

        return None if settings.model.family in SCRIPTED else load_of(load_policy, settings.followed())

    def check_loaded(self, decided: Decided[ExtractSettings], model: "Policy") -> None:
        """Raise UsageError for a loaded policy that the settings do not describe."""
        from probe_kit.hooks.registry import family_names

        card, requested = model.card, decided.settings.model
        pairs: dict[str, tuple[object, object]] = {}
        # A file may call its weights random; requested random weights have a seed.
        if requested.random_weights or card.weights_seed is not None:
            pairs["random_weights"] = requested.random_weights, card.random_weights
        if card.weights_seed is not None:
            pairs["weights_seed"] = requested.weights_seed, card.weights_seed
        if card.family in family_names():
            pairs["model"] = requested.family, card.family
        wrong = [f"{name} {has!r} instead of {right!r}" for name, (right, has) in pairs.items() if right != has]
        if wrong:
            raise UsageError(
                f"the loaded policy has {', '.join(wrong)}. Give the policy of these settings, or leave it out"
            )

    def fit(
        self, decided: Decided[ExtractSettings], source: Source[Any], model: "Policy | None"
    ) -> tuple[Fitted[ExtractSettings], Source[Any], LoadedModel]:
        """Show the source to a policy, count its inferences, and choose its batch where that was requested.

        Raises an error for whatever does not fit.
        """
        settings = decided.settings
        if settings.model.family in SCRIPTED:  # a script captures nothing, and refuses another batch than 1
            script = ScriptedController(settings.model.family)
            return count_calls(settings, execute=1), source, LoadedModel(script, observations=1)
        assert model is not None, "only scripts have no network"
        if not source.own_units:
            check_misfit(settings, model.embodiment_mismatch(), model.card.checkpoint)
        # The source first: it may give the policy further cameras, and batch and needs are those of that card.
        source, policy = source.check(model, settings.machine.accept_units)
        decided = fit_source(policy.card, decided, source)
        check_reachable(decided, policy.card, source)
        settings = decided.settings
        controller = PolicyController(policy, source, settings)
        fitted, calibration, batch = count_calls(settings, controller.execute), None, settings.machine.batch
        if batch == "auto":  # last, because it times the controller as the run will use it
            calibration = calibrate(fitted, controller, source, source.rows(settings.seed))
            fitted, batch = calibration.chosen_for(fitted), calibration.batch
        assert batch is not None, "settings name a number or auto"
        return fitted, source, LoadedModel(controller, batch, calibration)


def _declared_inputs(family: "Family", settings: ExtractSettings) -> "DeclaredInputs | None":
    """Return the inputs that a checkpoint in lerobot's layout declares; None without one."""
    from probe_kit.hooks.families.shared.lerobot.pipelines import declared_inputs

    return declared_inputs(family.folder_here(settings.model.checkpoint, settings.model.options))


def check_misfit(settings: ExtractSettings, reason: str | None, checkpoint: str) -> None:
    """Raise CheckpointError for a reason why actions cannot move this arm, unless nothing acts."""
    if not settings.task.capture_only and reason is not None:
        problem = with_origin(reason, settings.model.family, checkpoint)
        raise CheckpointError(
            f"{problem}. To capture activations without acting, add --no-act. Probing works as usual; there is no "
            "success rate"
        )


def check_reachable(decided: Decided[ExtractSettings], card: "ModelCard", source: Source[Any]) -> None:
    """Raise UsageError for more actions than a chunk has, or more captured inferences than an episode can have."""
    settings = decided.settings
    if settings.task.capture_only or not source.executes:
        return
    family, execute = settings.model.family, settings.task.execute or card.execute
    chunk = source.chunk or card.chunk
    if execute > chunk:
        raise UsageError(
            f"--execute {execute}: {family} gives {chunk} actions per inference; execute 1 to {chunk} of them"
        )
    if card.ensemble is not None and execute != 1:
        raise UsageError(
            f"--execute {execute}: {family} averages the plans of overlapping chunks, which needs an "
            "inference per action; leave --execute out, or the model's option that asks for averaging"
        )
    calls, most = settings.capture.captured_calls, settings.most_inferences(execute)
    if calls != "all" and calls > most:
        raise UsageError(
            f"--captured-calls {calls}: episodes of {settings.source.steps()} actions, {execute} per inference, "
            f"have at most {most}; capture 1 to {most} of them, or raise --max-steps"
        )


class Ask:
    """The task in which a model answers one question per row; its first inference may be captured."""

    names_all_items: ClassVar[bool] = True  # an object that is asked for may be that of any item

    def check_meaningless(self, settings: AskSettings) -> None:
        """Accept all settings: none is meaningless by itself."""

    def check_loaded(self, decided: Decided[AskSettings], model: "AnswerModel") -> None:
        """Accept every answer model."""

    def early_checks(
        self, decided: Decided[AskSettings], source: Source[Any], fetch: bool
    ) -> list[Callable[[], object]]:
        """Return no checks: the questions are read when the model is there."""
        del decided, source, fetch
        return []

    def declared_inputs(self, decided: Decided[AskSettings]) -> "DeclaredInputs | None":
        """Return None: the cameras of a question are chosen by the prompt."""
        del decided
        return None

    def planned(self, decided: Decided[AskSettings], sizes: PlannedSizes) -> Fitted[AskSettings]:
        """Return the settings: sizes decide nothing."""
        del sizes
        return count_calls(decided.settings, execute=1)

    def check_family(self, settings: AskSettings, family: "Family | None") -> None:
        """Raise UsageError for a model that acts."""
        if family is None or not family.abilities.reads:
            from probe_kit.hooks.registry import known_families

            reads = [name for name, candidate in known_families().items() if candidate.abilities.reads]
            raise UsageError(
                f"{settings.model.family} acts and does not answer questions; choose among {', '.join(reads)}"
            )

    def view_of(self, source: Source[Any]) -> Source[Any]:
        """Return the source with a row per question."""
        return source.for_questions()

    def rows(self, settings: AskSettings, source: Source[Any]) -> tuple[Row, ...]:
        """Return the rows with what a question asks for, where that is not the object of the instruction.

        Raises:
            UsageError: For items without such a phrase.
        """
        rows = source.rows(settings.seed)
        if settings.task.query == "target" or source.suite is None:
            return rows
        by_item = phrases(source.suite, settings.task.query, settings.seed)
        objects = {item: phrase.with_article for item, phrase in by_item.items()}
        return tuple(
            replace(row, columns={**row.columns, "asked_object": objects[row.columns["item_id"]]}) for row in rows
        )

    def texts(self, settings: AskSettings, source: Source[Any]) -> Iterable[str]:
        """Return the objects that are asked for, or the instructions of a source without objects."""
        if source.suite is None:
            return source.instructions
        objects = phrases(source.suite, settings.task.query, settings.seed)
        return dict.fromkeys(phrase.text for phrase in objects.values())

    def load(self, settings: AskSettings) -> "AnswerModel":
        """Load the model that is asked. Raises UsageError if it answers no questions, and as `load_model`."""
        from probe_kit.hooks import AnswerModel, load_model

        model = load_of(load_model, settings)
        if not isinstance(model, AnswerModel):
            raise UsageError(
                f"{settings.model.family} returned a {type(model).__name__}, not an AnswerModel; fix the loader"
            )
        return model

    def fit(
        self, decided: Decided[AskSettings], source: Source[Any], model: "AnswerModel | None"
    ) -> tuple[Fitted[AskSettings], Source[Any], LoadedModel]:
        """Show the source to the model, and choose how its answers are read."""
        assert model is not None, "no script answers"
        source = source.for_cameras(model.card.cameras)
        settings = fit_source(model.card, decided, source).settings
        controller = AnswerController(model, source, settings)
        return count_calls(settings, execute=1), source, LoadedModel(controller, settings.machine.batch)
