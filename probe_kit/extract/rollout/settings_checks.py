"""Checks for combinations of settings that would have no effect."""

from typing import TYPE_CHECKING

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.extract.rollout.controllers import SCRIPTED
from probe_kit.extract.settings import ExtractSettings, Settings
from probe_kit.extract.sources.recording import LeRobotSource
from probe_kit.extract.sources.scene import SceneSettings
from probe_kit.hooks.checkpoints.third_party import with_origin
from probe_kit.hooks.contract.card import ModelCard

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


def check_meaningless(settings: Settings) -> None:
    """Raise UsageError for what has no effect: a scripted policy has no weights, no chunks and no activations."""
    if settings.model.weights_seed and not settings.model.random_weights:
        raise UsageError(
            f"--weights-seed {settings.model.weights_seed} seeds random weights, and the checkpoint's were asked "
            "for. Leave it out, or add --random-weights"
        )
    if not isinstance(settings, ExtractSettings):
        return
    if not isinstance(settings.source, SceneSettings):
        _check_source(settings)
        return
    if settings.task.capture_only:
        _check_acting(settings)
    if settings.model.family not in SCRIPTED:
        return
    asked = {
        "--no-act": settings.task.capture_only,
        "--checkpoint": settings.model.checkpoint is not None,
        "--random-weights": settings.model.random_weights,
        "--batch": settings.machine.batch != 1,
        "--execute": settings.task.execute is not None,
        "--rotation": settings.task.rotation is not None,
        "--dtype": settings.model.dtype is not None,
        "--tokens all": settings.capture.tokens == "all",
        "--captured-calls": settings.capture.captured_calls != 1,
        **{f"-M {name}": True for name in settings.model.options},
    }
    if meaningless := [option for option, given in asked.items() if given]:
        raise UsageError(
            f"{', '.join(meaningless)} does not apply: {settings.model.family} is scripted and has no network. "
            "Remove it, or choose a model with weights"
        )


def _check_source(settings: ExtractSettings) -> None:
    """Raise UsageError for what only scenes have."""
    given = {
        "--protocol": settings.task.protocol is not None,
        "--rotation": settings.task.rotation is not None,
        "--video": settings.machine.video != "none",
        "--batch auto": settings.machine.batch == "auto",
    }
    if isinstance(settings.source, LeRobotSource):
        given |= {
            "--execute": settings.task.execute is not None,
            "--later-views": settings.capture.later_views != "all",
            "edits": bool(settings.task.edits),
        }
    else:
        given |= {"--no-act": settings.task.capture_only, "--frames all": settings.machine.frames == "all"}
    if meaningless := [option for option, is_given in given.items() if is_given]:
        raise UsageError(f"{', '.join(meaningless)} does not apply with {settings.source.shows}; remove it")
    if settings.model.family in SCRIPTED:
        raise UsageError(f"{settings.model.family} is scripted and looks at nothing; choose a model with weights")


def _check_acting(settings: ExtractSettings) -> None:
    acting = {
        "--captured-calls": settings.capture.captured_calls != 1,
        "--execute": settings.task.execute is not None,
        "--rotation": settings.task.rotation is not None,
        "--video": settings.machine.video != "none",
    }
    if meaningless := [option for option, given in acting.items() if given]:
        raise UsageError(
            f"{', '.join(meaningless)} does not apply with --no-act, which captures one inference per episode "
            "and executes no action; remove it"
        )


def check_embodiment(settings: ExtractSettings, policy: "Policy") -> None:
    """Raise CheckpointError for a policy whose actions cannot move this arm, unless it is only captured."""
    if not settings.task.capture_only:
        check_misfit(settings, policy.embodiment_mismatch(), policy.card.checkpoint)


def check_misfit(settings: ExtractSettings, reason: str | None, checkpoint: str) -> None:
    """Raise CheckpointError for a reason why actions cannot move this arm, unless nothing acts."""
    if not settings.task.capture_only and reason is not None:
        problem = with_origin(reason, settings.model.family, checkpoint)
        raise CheckpointError(
            f"{problem}. To capture activations without acting, add --no-act. Probing works as usual; there is no "
            "success rate"
        )


def check_unreachable(settings: ExtractSettings, card: ModelCard) -> None:
    """Raise UsageError for more actions than a chunk has, or more captured inferences than an episode can have."""
    if settings.task.capture_only:
        return
    if settings.task.execute is not None and settings.task.execute > card.chunk:
        raise UsageError(
            f"--execute {settings.task.execute}: {settings.model.family} gives {card.chunk} actions per "
            f"inference; execute 1 to {card.chunk} of them"
        )
    execute, steps = settings.task.execute or card.execute, settings.source.steps()
    if card.ensemble is not None and execute != 1:
        raise UsageError(
            f"--execute {execute}: {settings.model.family} averages the plans of overlapping chunks, which needs "
            "an inference per action; leave --execute out, or the model's option that asks for averaging"
        )
    inferences = settings.most_inferences(execute)
    if settings.capture.captured_calls != "all" and settings.capture.captured_calls > inferences:
        raise UsageError(
            f"--captured-calls {settings.capture.captured_calls}: episodes of {steps} actions, {execute} per "
            f"inference, have at most {inferences}; capture 1 to {inferences} of them, or raise --max-steps"
        )
