"""The controller of recorded frames: a policy predicts about each, and nothing is executed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ObservationError, PolicyFailedError, RecordingError
from probe_kit.extract.recordings.early_fit import check_state_width, raise_together
from probe_kit.extract.recordings.lerobot_folder import fetched
from probe_kit.extract.recordings.recorded_plan import Recording
from probe_kit.extract.rollout.controllers import PolicyController, Turn
from probe_kit.extract.rollout.preflight import MOST_UNUSUAL, check_units, other_order, unusual_shares
from probe_kit.extract.rollout.recorded.recorded_stage import example_of
from probe_kit.extract.settings import ExtractSettings
from probe_kit.extract.sources.recording import ACTION, STATE
from probe_kit.hooks.checkpoints.containment import copied
from probe_kit.hooks.checkpoints.third_party import while_acting

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


class RecordedController(PolicyController):
    """Predicts about every frame with the checkpoint's own units, and captures every inference."""

    def act(self, turns: Sequence[Turn]) -> list[NDArray[np.float32]]:
        """Per turn the whole predicted chunk (chunk, D)."""
        return super().act(turns)

    def _chunks(self, turns: Sequence[Turn], seeds: Sequence[int]) -> NDArray[np.float32]:
        chunks = self.policy.predict(copied([turn.seen for turn in turns]), list(seeds))
        check_predictions(chunks, len(turns))
        return np.array(chunks)

    def _executed(self, turn: Turn, chunk: NDArray[np.float32]) -> NDArray[np.float32]:
        del turn
        return chunk

    def certificate(self) -> dict[str, Any]:
        """As of a policy that acts, without the rotation of actions."""
        return {name: value for name, value in super().certificate().items() if name != "rotation"}


@dataclass(frozen=True)
class Fitted:
    """A recording with its cameras mapped, and a policy that was found to take it.

    prediction: (chunk, D). unusual: (D,) share of the chosen frames whose number of the state is unusual; empty
    where the policy normalises none. other_actions: why recorded actions are not what it predicts; None if they
    are.
    """

    recording: Recording
    policy: "Policy"
    prediction: tuple[int, int]
    unusual: NDArray[np.float64]
    other_actions: str | None = None


def fit(recording: Recording, policy: "Policy") -> Fitted:
    """Map the cameras, read all numbers of the chosen episodes, and let the policy predict once about nothing.

    Raises RecordingError for cameras, states or files that do not fit, and CheckpointError for a checkpoint
    without statistics.
    """
    raise_together(
        [
            lambda: recording.mapped(policy.card.cameras),
            lambda: check_state_width(recording, policy.card.checkpoint, policy.state_numbers),
        ]
    )
    return _fit_mapped(recording.mapped(policy.card.cameras), policy)


def _fit_mapped(recording: Recording, policy: "Policy") -> Fitted:
    fetched(recording.folder, recording.episodes, recording.features)
    recording.check()
    try:
        policy = policy.with_cameras([camera for camera, _ in recording.source.cameras])
    except ObservationError as error:
        raise RecordingError(f"{error}. Map the model's first cameras with --camera") from error
    numbers = _chosen_numbers(recording)
    unusual = _unusual(recording, policy, numbers.get(STATE))
    example = example_of(recording, recording.instructions[0])
    with while_acting(policy.card.family, policy.card.checkpoint):
        chunk = policy.predict(copied([example]), [0])
        check_predictions(chunk, 1)
    other_actions = _other_actions(recording, policy, chunk.shape[2], numbers.get(ACTION))
    return Fitted(recording, policy, (chunk.shape[1], chunk.shape[2]), unusual, other_actions)


def recorded_controller(fitted: Fitted, settings: ExtractSettings) -> RecordedController:
    """The controller of a run on a recording."""
    recording = fitted.recording
    examples = [example_of(recording, text) for text in recording.instructions]
    controller = RecordedController(
        fitted.policy, settings.model.family, examples, None, settings.capture.calls,
        settings.capture.tokens == "all",        limit=settings.machine.inference_limit,
    )  # fmt: skip
    del controller.identity["execute"]
    return controller


def _chosen_numbers(recording: Recording) -> dict[str, NDArray[np.float32]]:
    """(n, D) state and action of every chosen frame, as far as they are recorded."""
    wanted = [name for name in (STATE, ACTION) if recording.folder.width(name) is not None]
    found = [recording.reader.numbers(one, wanted) for one in recording.episodes]
    every = recording.source.every
    return {name: np.concatenate([one[name][::every] for one in found]).astype(np.float32) for name in wanted}


def _unusual(recording: Recording, policy: "Policy", states: NDArray[np.float32] | None) -> NDArray[np.float64]:
    if states is None:
        return np.zeros(0)
    if not np.isfinite(states).all():
        name = recording.folder.path.name
        raise RecordingError(f"{name}: {STATE} holds NaN or infinity; leave such episodes out")
    return unusual_shares(policy, states)


def _other_actions(
    recording: Recording, policy: "Policy", predicted: int, actions: NDArray[np.float32] | None
) -> str | None:
    """Why the recorded actions are not what a policy predicts; None if they are, as far as anything says."""
    if actions is None:
        return "the data set has no actions"
    if actions.shape[1] != predicted:
        return f"the policy predicts {predicted} numbers, the data set has {actions.shape[1]}"
    if policy.predicts_relative:
        return "the policy predicts changes relative to the state (use_relative_actions)"
    if (reason := other_order(policy, recording.folder.meta.names(ACTION) or ())) is not None:
        return reason
    shares = policy.unusual_actions(actions).mean(axis=0)
    if not (shares > MOST_UNUSUAL).any():
        return None
    names = recording.folder.names(ACTION)
    far = ", ".join(f"{names[one]} {shares[one]:.0%}" for one in np.flatnonzero(shares > MOST_UNUSUAL))
    return f"recorded actions lie outside the statistics of the checkpoint ({far}), so the units differ"


def check_recorded_units(fitted: Fitted, accepted: bool) -> None:
    """Raise UnitsError for recorded states far outside the checkpoint's statistics, unless that is accepted."""
    folder = fitted.recording.folder
    names = folder.names(STATE) if fitted.unusual.size else []
    check_units(fitted.unusual, names, f"{folder.path.name}, {STATE}", fitted.policy, accepted)


def check_predictions(chunks: Any, count: int) -> None:
    """Raise PolicyFailedError unless these are (count, chunk, D) float32."""
    if not (
        isinstance(chunks, np.ndarray) and chunks.ndim == 3 and len(chunks) == count and chunks.dtype == np.float32
    ):
        seen = f"{chunks.shape} {chunks.dtype}" if isinstance(chunks, np.ndarray) else type(chunks).__name__
        raise PolicyFailedError(
            f"the policy predicted {seen} for {count} observations; expected float32 ({count}, chunk, actions)"
        )
