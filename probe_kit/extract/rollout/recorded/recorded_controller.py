"""The controller of recorded frames: a policy predicts about each, and nothing is executed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ObservationError, PolicyFailedError, RecordingError
from probe_kit.extract.recordings.lerobot_folder import fetched
from probe_kit.extract.recordings.lerobot_source import STATE
from probe_kit.extract.recordings.recorded_plan import Recording
from probe_kit.extract.rollout.controllers import PolicyController, Turn
from probe_kit.extract.rollout.recorded.recorded_stage import example_of
from probe_kit.extract.settings import ExtractSettings
from probe_kit.hooks.checkpoints.containment import copied
from probe_kit.hooks.checkpoints.third_party import while_acting

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

MOST_UNUSUAL = 0.2
"""Share of unusual values of one number of the state, above which a run is refused."""


class RecordedController(PolicyController):
    """Predicts about every frame with the checkpoint's own units, and captures every inference."""

    def act(self, turns: Sequence[Turn]) -> list[NDArray[np.float32]]:
        """Per turn the whole predicted chunk (chunk, D)."""
        return super().act(turns)

    def _chunks(self, turns: Sequence[Turn], seeds: Sequence[int]) -> NDArray[np.float32]:
        chunks = self.policy.predict(copied([turn.seen for turn in turns]), list(seeds))
        _check_predictions(chunks, len(turns))
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
    where the policy normalises none.
    """

    recording: Recording
    policy: "Policy"
    prediction: tuple[int, int]
    unusual: NDArray[np.float64]


def fit(recording: Recording, policy: "Policy") -> Fitted:
    """Map the cameras, read all numbers of the chosen episodes, and let the policy predict once about nothing.

    Raises RecordingError for cameras, states or files that do not fit, and CheckpointError for a checkpoint
    without statistics.
    """
    recording = recording.mapped(policy.card.cameras)
    fetched(recording.folder, recording.episodes, recording.features)
    recording.folder.check_files(recording.episodes, recording.features)
    try:
        policy = policy.with_cameras([camera for camera, _ in recording.source.cameras])
    except ObservationError as error:
        raise RecordingError(f"{error}. Map the model's first cameras with --camera") from error
    unusual = _unusual(recording, policy)
    example = example_of(recording, recording.instructions()[0])
    with while_acting(policy.card.family, policy.card.checkpoint):
        chunk = policy.predict(copied([example]), [0])
        _check_predictions(chunk, 1)
    return Fitted(recording, policy, (chunk.shape[1], chunk.shape[2]), unusual)


def recorded_controller(fitted: Fitted, settings: ExtractSettings) -> RecordedController:
    """The controller of a run on a recording."""
    recording = fitted.recording
    examples = [example_of(recording, text) for text in recording.instructions()]
    controller = RecordedController(
        fitted.policy, settings.model, examples, None, settings.stored_calls, settings.tokens == "all",
        limit=settings.inference_limit,
    )  # fmt: skip
    del controller.identity["execute"]
    return controller


def _unusual(recording: Recording, policy: "Policy") -> NDArray[np.float64]:
    folder, expected = recording.folder, policy.state_numbers
    width = folder.width(STATE)
    if expected is None:
        return np.zeros(0)
    if width != expected:
        seen = "no " + STATE if width is None else f"{width} numbers as {STATE}"
        raise RecordingError(
            f"{folder.path.name} has {seen}; {policy.card.checkpoint} reads {expected}. Take the data set's own "
            "checkpoint, or a data set of this robot"
        )
    rows = [recording.reader.numbers(one, [STATE])[STATE][:: recording.source.every] for one in recording.episodes]
    states = np.concatenate(rows).astype(np.float32)
    if not np.isfinite(states).all():
        raise RecordingError(f"{folder.path.name}: {STATE} holds NaN or infinity; leave such episodes out")
    shares: NDArray[np.float64] = policy.unusual_states(states).mean(axis=0)
    return shares


def check_units(fitted: Fitted) -> None:
    """Raise RecordingError for states far outside the checkpoint's statistics, unless that is accepted."""
    shares, folder = fitted.unusual, fitted.recording.folder
    if fitted.recording.source.accept_units or not (shares > MOST_UNUSUAL).any():
        return
    names = folder.names(STATE)
    worst = ", ".join(f"{names[one]} {shares[one]:.0%}" for one in np.flatnonzero(shares > MOST_UNUSUAL))
    raise RecordingError(
        f"{folder.path.name}: of the frames' {STATE} many values lie outside the statistics of "
        f"{fitted.policy.card.checkpoint} ({worst}); expected at most {MOST_UNUSUAL:.0%} of each number. The "
        "units or the robot differ: take the data set's own checkpoint, or accept it with --accept-units"
    )


def _check_predictions(chunks: Any, count: int) -> None:
    """Raise PolicyFailedError unless these are (count, chunk, D) float32."""
    if not (
        isinstance(chunks, np.ndarray) and chunks.ndim == 3 and len(chunks) == count and chunks.dtype == np.float32
    ):
        seen = f"{chunks.shape} {chunks.dtype}" if isinstance(chunks, np.ndarray) else type(chunks).__name__
        raise PolicyFailedError(
            f"the policy predicted {seen} for {count} observations; expected float32 ({count}, chunk, actions)"
        )
