"""Checks for combinations of settings that would have no effect."""

from typing import TYPE_CHECKING

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.extract.recordings.lerobot_source import LeRobotSource
from probe_kit.extract.rollout.controllers import SCRIPTED
from probe_kit.extract.settings import ExtractSettings, RunSettings
from probe_kit.hooks.checkpoints.third_party import with_origin
from probe_kit.hooks.contract.card import ModelCard

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


def check_meaningless(settings: RunSettings) -> None:
    """Raise UsageError for what has no effect: a scripted policy has no weights, no chunks and no activations."""
    if settings.weights_seed and not settings.random_weights:
        raise UsageError(
            f"--weights-seed {settings.weights_seed} seeds random weights, and the checkpoint's were asked for. "
            "Leave it out, or add --random-weights"
        )
    if not isinstance(settings, ExtractSettings):
        return
    if settings.source is not None:
        _check_source(settings)
        return
    if settings.capture_only:
        _check_acting(settings)
    if settings.model not in SCRIPTED:
        return
    asked = {
        "--no-act": settings.capture_only,
        "--checkpoint": settings.checkpoint is not None,
        "--random-weights": settings.random_weights,
        "--batch": settings.batch != 1 or settings.calibrate,
        "--execute": settings.execute is not None,
        "--rotation": settings.rotation is not None,
        "--dtype": settings.dtype is not None,
        "--tokens all": settings.tokens == "all",
        "--captured-calls": settings.captured_calls != 1,
        **{f"-M {name}": True for name in settings.options},
    }
    if meaningless := [option for option, given in asked.items() if given]:
        raise UsageError(
            f"{', '.join(meaningless)} does not apply: {settings.model} is scripted and has no network. Remove "
            "it, or choose a model with weights"
        )


def _check_source(settings: ExtractSettings) -> None:
    """Raise UsageError for what only scenes have."""
    recorded = isinstance(settings.source, LeRobotSource)
    given = {
        "--suite": settings.suite is not None,
        "--categories": settings.categories is not None,
        "--items": settings.items is not None,
        "--wordings": settings.wordings is not None,
        "--protocol": settings.protocol is not None,
        "--rotation": settings.rotation is not None,
        "--video": settings.video != "none",
        "--batch auto": settings.calibrate,
    }
    if recorded:
        why = "--dataset, which shows recorded frames and executes no action"
        given |= {
            "--execute": settings.execute is not None,
            "--later-views": settings.later_views != "all",
            "edits": bool(settings.edits),
        }
    else:
        why = "--env, in which the model acts in its own units"
        given |= {"--no-act": settings.capture_only, "--frames all": settings.frames == "all"}
    if meaningless := [option for option, is_given in given.items() if is_given]:
        raise UsageError(f"{', '.join(meaningless)} does not apply with {why}; remove it")
    if settings.model in SCRIPTED:
        raise UsageError(f"{settings.model} is scripted and looks at nothing; choose a model with weights")


def _check_acting(settings: ExtractSettings) -> None:
    acting = {
        "--captured-calls": settings.captured_calls != 1,
        "--execute": settings.execute is not None,
        "--rotation": settings.rotation is not None,
        "--video": settings.video != "none",
    }
    if meaningless := [option for option, given in acting.items() if given]:
        raise UsageError(
            f"{', '.join(meaningless)} does not apply with --no-act, which captures one inference per episode "
            "and executes no action; remove it"
        )


def check_embodiment(settings: ExtractSettings, policy: "Policy") -> None:
    """Raise CheckpointError for a policy whose actions cannot move this arm, unless it is only captured."""
    if not settings.capture_only:
        check_misfit(settings, policy.embodiment_mismatch(), policy.card.checkpoint)


def check_misfit(settings: ExtractSettings, reason: str | None, checkpoint: str) -> None:
    """Raise CheckpointError for a reason why actions cannot move this arm, unless nothing acts."""
    if not settings.capture_only and reason is not None:
        problem = with_origin(reason, settings.model, checkpoint)
        raise CheckpointError(
            f"{problem}. To capture activations without acting, add --no-act. Probing works as usual; there is no "
            "success rate"
        )


def check_unreachable(settings: ExtractSettings, card: ModelCard) -> None:
    """Raise UsageError for more actions than a chunk has, or more captured inferences than an episode can have."""
    if settings.capture_only:
        return
    if settings.execute is not None and settings.execute > card.chunk:
        raise UsageError(
            f"--execute {settings.execute}: {settings.model} gives {card.chunk} actions per inference; execute "
            f"1 to {card.chunk} of them"
        )
    execute, steps = settings.execute or card.execute, settings.episode_steps
    if card.ensemble is not None and execute != 1:
        raise UsageError(
            f"--execute {execute}: {settings.model} averages the plans of overlapping chunks, which needs an "
            "inference per action; leave --execute out, or the model's option that asks for averaging"
        )
    inferences = settings.most_inferences(execute)
    if settings.captured_calls != "all" and settings.captured_calls > inferences:
        raise UsageError(
            f"--captured-calls {settings.captured_calls}: episodes of {steps} actions, {execute} per inference, "
            f"have at most {inferences}; capture 1 to {inferences} of them, or raise --max-steps"
        )
