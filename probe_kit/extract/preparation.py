"""Preparation of a run, from top to bottom: settings, source, checks, model, plan. Writes nothing."""

import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.bounded_json import parse_json
from probe_kit._system.installing import install_command
from probe_kit.errors import CheckpointError, DiskSpaceError, MissingExtraError, UsageError
from probe_kit.extract.calibration import Calibration, calibrated
from probe_kit.extract.config_files import CONFIG, portable
from probe_kit.extract.needs import PlannedSizes, planned_sizes
from probe_kit.extract.plan import Plan, Row
from probe_kit.extract.rollout.answer_controller import AnswerController, asked_rows
from probe_kit.extract.rollout.controllers import SCRIPTED, Controller, PolicyController, ScriptedController
from probe_kit.extract.settings import AskSettings, ExtractSettings, Settings, refuse, run_label
from probe_kit.extract.sources.recording import IMAGES, STATE
from probe_kit.extract.sources.source import Source
from probe_kit.extract.vqa.phrases import phrases
from probe_kit.hashing import canonical_json, sha256_json
from probe_kit.hooks.checkpoints.checkpoint import CONFIG_FILE
from probe_kit.hooks.checkpoints.third_party import with_origin
from probe_kit.runs.growth import check_other_settings, further_rows
from probe_kit.runs.layout import RUN_FILE, StoredStream
from probe_kit.runs.provenance import provenance_here
from probe_kit.runs.root import read_root
from probe_kit.runs.store import Location
from probe_kit.runs.writer import RunWriter

if TYPE_CHECKING:
    from probe_kit.hooks import AnswerModel, Model, Policy
    from probe_kit.hooks.contract.card import ModelCard

_OF_THE_CHECKPOINT = ("dtype", "execute", "random_weights", "captured_calls")
"""Settings whose value the loaded model may decide."""
_SCRIPT_REFUSES = (
    "capture_only", "checkpoint", "random_weights", "batch", "execute", "rotation", "dtype", "tokens=all",
    "captured_calls", "options",
)  # fmt: skip
_CAPTURE_REFUSES = ("captured_calls", "execute", "rotation", "video")
_EMPTY_CAMERA = "empty_camera"
"""Beginning of the name of a camera that never gets a picture."""


@dataclass(frozen=True)
class Prepared:
    """The beginning of a run: the source is open, the model is loaded and the plan is made.

    source: as the model is shown it. card: the part of the identity that the loaded model decides. controller:
    None if the model is loaded again by workers elsewhere. calibration: what chose the batch, None if it was not
    requested or is left to workers. declared: whose sizes the streams have where no model was loaded and the run
    has no name yet; empty where one was.
    """

    settings: Settings
    source: Source[Any]
    plan: Plan
    card: dict[str, Any]
    controller: Controller | None
    calibration: Calibration | None = None
    declared: str = ""

    def identity(self) -> dict[str, Any]:
        """Everything that decides the numbers of an episode: neither which are selected, nor machine and label.

        Runs with equal identity have equal numbers in the episodes that both have.
        """
        return {**self.settings.identity(), **self.card, **self.plan.identity}

    def provenance(self) -> dict[str, Any]:
        """The provenance of a process that plays with these settings here; with the decoder of recorded videos."""
        dtype: str | None = self.card.get("dtype")
        decoder = {} if self.plan.decoder is None else {"decoder": self.plan.decoder}
        return provenance_here(self.settings.machine.device, dtype) | decoder

    def writer(self, location: Location) -> RunWriter[Plan]:
        """A writer of the run at `location`, which it begins or continues.

        Raises SettingsMismatchError if other settings are there.
        """
        return RunWriter(location, self.plan, self.identity(), self.provenance(), run_label(self.settings))

    def default_name(self) -> str:
        """Folder name that repeats for the same settings, so that the same command finds its run again.

        A command with more items finds it too; one with other categories, wordings or another suite does not.
        """
        hashed = [self.identity(), *self.plan.name_parts]
        # Without the weights' hash there is no name yet.
        return self.settings.folder_name("…" if self.declared else sha256_json(hashed)[:8])


def load(
    settings: Settings,
    rehearsed: bool = False,
    location: Location | None = None,
    answer_model: "AnswerModel | None" = None,
    policy: "Policy | None" = None,
    fetch: bool = True,
) -> Prepared:
    """Open the source, load the model and plan the rows.

    rehearsed: whether the source was tried before. location: where it will be written, if that is known, so that
    it is looked at before the model is loaded. answer_model, policy: the model of these settings, if it is loaded
    already; it may be one of your own, and several runs can share it. fetch: False makes the plan of the streams
    that the model's family declares: without weights, network or GPU. A family that declares none is loaded.
    Raises UsageError for a policy of another family or with other weights than the settings name, and what these
    raise: UnknownModelError, UnknownCategoryError, SuiteError, RecordingError, OwnEnvironmentError, WeightsError …
    """
    model = policy if answer_model is None else answer_model
    settings, source = open_checked(settings, location, model is not None, fetch)
    rows = _rows(settings, source)
    if not rehearsed:
        source.rehearse(rows)
    if model is None:
        _check_before_loading(settings, source, fetch)
    if not fetch and (sizes := planned_sizes(settings, source.instructions)) is not None:
        settings, card = _planned_settings(settings, sizes), _declared_card(settings)
        plan = _plan(settings, source, rows, sizes.streams, settings.execute or sizes.execute)
        return Prepared(settings, source, plan, card, None, declared=sizes.source)
    if isinstance(settings, AskSettings):
        return _with_answers(
            settings, source, load_answer_model(settings) if answer_model is None else answer_model
        )
    assert isinstance(settings, ExtractSettings)
    if settings.model.family in SCRIPTED:
        script = ScriptedController(settings.model.family)
        return Prepared(settings, source, _plan(settings, source, rows, []), script.identity, script)
    if policy is not None:
        _check_loaded(settings, policy)
    return _with_policy(settings, source, load_acting_policy(settings) if policy is None else policy)


def _with_answers(settings: AskSettings, source: Source[Any], model: "AnswerModel") -> Prepared:
    """The run of a model that answers and is loaded."""
    source = source.watched(model.card.cameras)
    settings = settings.changed(source=source.settings) if source.settings != settings.source else settings
    check_fit(model.card, settings, source)
    asking = AnswerController(model, source, settings)
    plan = _plan(settings, source, _rows(settings, source), asking.streams, 0)
    return Prepared(settings, source, plan, asking.identity, asking)


def _with_policy(settings: ExtractSettings, source: Source[Any], policy: "Policy") -> Prepared:
    """The run of a policy that is loaded."""
    if not source.own_units:
        check_misfit(settings, policy.embodiment_mismatch(), policy.card.checkpoint)
    source, policy = source.check(policy, settings.machine.accept_units)
    settings = settings.changed(source=source.settings) if source.settings != settings.source else settings
    check_fit(policy.card, settings, source)
    check_reachable(settings, policy.card, source)
    controller = PolicyController(policy, source, settings)
    settings = settings.with_every_call(controller.execute)
    plan = _plan(settings, source, _rows(settings, source), controller.streams, controller.execute)
    if settings.machine.batch == "auto":
        settings, calibration = calibrated(settings, controller, source, plan)
        return Prepared(settings, source, plan, controller.identity, controller, calibration)
    return Prepared(settings, source, plan, controller.identity, controller)


def open_checked(
    settings: Settings, location: Location | None = None, loaded: bool = False, fetch: bool = True
) -> tuple[Settings, Source[Any]]:
    """The settings with what protocol and source decide, and the open source; all is checked that needs no model.

    loaded: the model is there already, and may be one that no name leads to. fetch: see `Family.check`. Raises as
    `load`.
    """
    check_meaningless(settings)
    settings = settings.followed()
    if not loaded:
        check_model(settings, fetch)
    if location is not None:
        _check_writable(location)
    source = settings.source.open(not fetch and _selects_only(settings, location))
    source = source.for_questions() if isinstance(settings, AskSettings) else source
    if decided := {name: value for name, value in source.decided().items() if name in settings.names()}:
        settings = settings.changed(**decided)
    if not loaded:
        _check_words(settings, source)
    if location is not None:
        _check_other_run(settings, source, location)
    return settings, source


# -- checks that need no model --------------------------------------------------------------------------------


def check_meaningless(settings: Settings) -> None:
    """Raise UsageError for settings that would have no effect with this source, task or model."""
    model = settings.model
    if model.weights_seed and not model.random_weights:
        raise UsageError(
            f"--weights-seed {model.weights_seed} seeds random weights, and the checkpoint's were asked for. "
            "Leave it out, or add --random-weights"
        )
    source, script = settings.source, model.family in SCRIPTED
    refuse(settings, source.refuses, f"does not apply with {source.shows}; remove it")
    if not isinstance(settings, ExtractSettings):
        return
    if script and source.command:
        raise UsageError(f"{model.family} is scripted and looks at nothing; choose a model with weights")
    if settings.task.capture_only and not source.command:
        why = "which captures one inference per episode and executes no action; remove it"
        refuse(settings, _CAPTURE_REFUSES, f"does not apply with --no-act, {why}")
    if script:
        why = f"{model.family} is scripted and has no network. Remove it, or choose a model with weights"
        refuse(settings, _SCRIPT_REFUSES, f"does not apply: {why}")


def check_model(settings: Settings, fetch: bool = True) -> None:
    """Refuse a model, option, device or checkpoint that cannot be used; imports no torch.

    fetch: see `Family.check`. Raises UnknownModelError and what `Family.check` raises.
    """
    if settings.machine.ray is not None and find_spec("ray") is None:
        raise MissingExtraError(f"--ray needs ray, which is not installed; `{install_command('ray')}`")
    from probe_kit.hooks.registry import find_family, known_families

    model, scripts, asks = settings.model, tuple(SCRIPTED), isinstance(settings, AskSettings)
    if asks and (model.family in SCRIPTED or not find_family(model.family, scripts).reads):
        reads = [name for name, family in known_families().items() if family.reads]
        raise UsageError(f"{model.family} acts and does not answer questions; those that do: {', '.join(reads)}")
    if model.family in SCRIPTED:
        return
    family = find_family(model.family, scripts)
    if not asks and not family.acts:
        raise UsageError(f"{model.family} answers and does not act; use `probe-kit ask`, or a model that acts")
    in_scene = not settings.source.command
    if isinstance(settings, ExtractSettings) and in_scene and not settings.task.capture_only:
        family.check_acting(model.checkpoint, model.options)
    # Elsewhere there may be other devices than here.
    device = "cpu" if settings.machine.elsewhere else settings.machine.device
    family.check(
        model.checkpoint, device, model.dtype, model.random_weights, model.options, model.weights_seed, fetch
    )


def _check_words(settings: Settings, source: Source[Any]) -> None:
    """Raise InstructionError for instructions, or objects of questions, with unknown words."""
    from probe_kit.hooks.registry import find_family

    if settings.model.family in SCRIPTED:
        return
    texts: Iterable[str] = source.instructions
    if isinstance(settings, AskSettings):
        if source.suite is not None:
            objects = phrases(source.suite, settings.task.query, settings.seed)
            texts = dict.fromkeys(phrase.text for phrase in objects.values())
    elif settings.source.command:  # said together with cameras and state, see `_check_before_loading`
        return
    find_family(settings.model.family, tuple(SCRIPTED)).check_words(texts, settings.model.checkpoint)


def _check_before_loading(settings: Settings, source: Source[Any], fetch: bool) -> None:
    """Raise for instructions that a policy cannot read, units that have to be chosen, and inputs that do not fit.

    As far as the checkpoint's files declare them; before its network is loaded.
    """
    from probe_kit.extract.sources.recording_source import raise_together
    from probe_kit.hooks.registry import get_family

    model, family = settings.model, get_family(settings.model.family)
    if family is None or not isinstance(settings, ExtractSettings):
        return

    def check_instructions() -> None:
        if settings.source.command:
            family.check_words(source.instructions, model.checkpoint)
        family.whose_units(model.checkpoint, model.options, fetch)
        family.check_instructions(model.checkpoint, source.instructions, model.options, fetch)

    checks: list[Callable[[], object]] = [check_instructions]
    if (inputs := _declared_inputs(settings)) is not None:
        checks += source.early_checks(*inputs, model.checkpoint or model.family)
    raise_together(checks)


def _declared_inputs(settings: Settings) -> tuple[tuple[str, ...], int | None] | None:
    """Cameras and numbers of the state that a checkpoint in lerobot's layout declares; None where none is here."""
    from probe_kit.hooks.registry import find_family

    model = settings.model
    folder = find_family(model.family, tuple(SCRIPTED)).folder_here(model.checkpoint, model.options)
    try:
        inputs = parse_json(read_regular(folder / CONFIG_FILE))["input_features"]
        cameras = [name.removeprefix(IMAGES) for name in inputs if name.startswith(IMAGES)]
        state = int(inputs[STATE]["shape"][0]) if STATE in inputs else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError):
        return None  # another layout; what it reads is known once it is loaded
    return tuple(name for name in cameras if not name.startswith(_EMPTY_CAMERA)), state


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


def _check_other_run(settings: Settings, source: Source[Any], location: Location) -> None:
    """Raise SettingsMismatchError for a place where a run lies that has other settings or cannot grow so.

    Only what is known without the model is compared; the writer compares all of it. Raises RunDamagedError if what
    lies there was changed.
    """
    early = source.known_early()
    with location.in_words():
        if early is None or not location.exists(RUN_FILE):
            return
        root = read_root(location)
        root.check_continuable()
        decided = {name: value for name, value in settings.identity().items() if name not in _OF_THE_CHECKPOINT}
        requested = json.loads(canonical_json({**decided, **early}))
        stored = {name: root.own_settings[name] for name in requested if name in root.own_settings}
        check_other_settings(stored, {name: requested[name] for name in stored}, str(location))
        if root.plan:
            further_rows(root.plan, [row.to_json() for row in _rows(settings, source)], str(location))


def _selects_only(settings: Settings, location: Location | None) -> bool:
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


def check_recording(settings: ExtractSettings, source: Source[Any]) -> None:
    """Raise as `load` what a model, its options and its words say of a source before weights are loaded."""
    check_meaningless(settings)
    check_model(settings)
    _check_before_loading(settings, source, fetch=True)


# -- the model ------------------------------------------------------------------------------------------------


def load_answer_model(settings: AskSettings) -> "AnswerModel":
    """The model that is asked. Raises UsageError if it answers no questions, and what `load_model` raises."""
    from probe_kit.hooks import AnswerModel, load_model

    model = _loaded(load_model, settings)
    if not isinstance(model, AnswerModel):
        raise UsageError(
            f"{settings.model.family} returned a {type(model).__name__}, not a AnswerModel; fix the loader"
        )
    return model


def load_acting_policy(settings: ExtractSettings) -> "Policy":
    """The policy that acts, with what its protocol decides. Raises what `load_policy` raises."""
    from probe_kit.hooks import load_policy

    return _loaded(load_policy, settings.followed())


def _loaded[Loaded: Model](load_by_name: Callable[..., Loaded], settings: Settings) -> Loaded:
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


def _check_loaded(settings: ExtractSettings, policy: "Policy") -> None:
    """Raise UsageError for a loaded policy that the settings do not describe."""
    from probe_kit.hooks.registry import family_names

    card, model = policy.card, settings.model
    pairs: dict[str, tuple[object, object]] = {}
    # A file may call its weights random; requested random weights have a seed.
    if model.random_weights or card.weights_seed is not None:
        pairs["random_weights"] = model.random_weights, card.random_weights
    if card.weights_seed is not None:
        pairs["weights_seed"] = model.weights_seed, card.weights_seed
    if card.family in family_names():
        pairs["model"] = model.family, card.family
    wrong = [
        f"{name} {has!r} instead of {requested!r}" for name, (requested, has) in pairs.items() if requested != has
    ]
    if wrong:
        raise UsageError(
            f"the loaded policy has {', '.join(wrong)}. Give the policy of these settings, or leave it out"
        )


def check_misfit(settings: ExtractSettings, reason: str | None, checkpoint: str) -> None:
    """Raise CheckpointError for a reason why actions cannot move this arm, unless nothing acts."""
    if not settings.task.capture_only and reason is not None:
        problem = with_origin(reason, settings.model.family, checkpoint)
        raise CheckpointError(
            f"{problem}. To capture activations without acting, add --no-act. Probing works as usual; there is no "
            "success rate"
        )


def check_fit(card: "ModelCard", settings: Settings, source: Source[Any]) -> None:
    """Raise UsageError if a model takes smaller batches, or needs what the source does not show."""
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


def check_reachable(settings: ExtractSettings, card: "ModelCard", source: Source[Any]) -> None:
    """Raise UsageError for more actions than a chunk has, or more captured inferences than an episode can have."""
    if settings.task.capture_only or not source.executes:
        return
    family, execute, chunk = (
        settings.model.family,
        settings.task.execute or card.execute,
        source.chunk or card.chunk,
    )
    if execute > chunk:
        raise UsageError(
            f"--execute {execute}: {family} gives {chunk} actions per inference; execute 1 to {chunk} of them"
        )
    if card.ensemble is not None and execute != 1:
        raise UsageError(
            f"--execute {execute}: {family} averages the plans of overlapping chunks, which needs an "
            "inference per action; leave --execute out, or the model's option that asks for averaging"
        )
    calls, steps, most = (
        settings.capture.captured_calls,
        settings.source.steps(),
        settings.most_inferences(execute),
    )
    if calls != "all" and calls > most:
        raise UsageError(
            f"--captured-calls {calls}: episodes of {steps} actions, {execute} per inference, have at most "
            f"{most}; capture 1 to {most} of them, or raise --max-steps"
        )


# -- the plan -------------------------------------------------------------------------------------------------


def _rows(settings: Settings, source: Source[Any]) -> tuple[Row, ...]:
    rows = source.rows(settings.seed)
    return asked_rows(rows, source, settings) if isinstance(settings, AskSettings) else rows


def _plan(
    settings: Settings,
    source: Source[Any],
    rows: tuple[Row, ...],
    streams: Iterable[StoredStream],
    execute: int = 1,
) -> Plan:
    """The plan of rows that store these streams. execute: actions per inference, 0 where none are predicted."""
    capture, streams = settings.capture, tuple(streams)
    size = sum(stream.raw_bytes(capture.tokens == "all", capture.calls, capture.later_views) for stream in streams)
    return Plan(
        rows,
        streams,
        size * len(rows),
        source.identity(execute),
        {**source.selection(rows), CONFIG: portable(settings)},
        source.name_parts(),
        source.suite_parent,
        source.decoder,
    )


def _planned_settings(settings: Settings, sizes: PlannedSizes) -> Settings:
    """The settings with the inferences of an episode counted. Raises CheckpointError for who cannot act."""
    in_scene = not settings.source.command
    if isinstance(settings, ExtractSettings) and in_scene and sizes.outline is not None:
        check_misfit(settings, sizes.outline.misfit(), sizes.outline.checkpoint)
    return settings.with_every_call(settings.execute or sizes.execute)


def _declared_card(settings: Settings) -> dict[str, Any]:
    """The part of the identity of a model that was not loaded."""
    requested: Mapping[str, Any] = {"dtype": settings.model.dtype, "execute": settings.execute}
    declared = {name: value for name, value in requested.items() if value is not None}
    model = {"model": settings.model.family, "random_weights": settings.model.random_weights}
    return {**model, "weights_sha256": None, **declared}
