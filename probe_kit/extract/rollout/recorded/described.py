"""What `probe-kit dataset show` says of a data set, and of a model that is to be shown it."""

from collections.abc import Sequence

from probe_kit.extract.recordings.recorded_plan import Recording
from probe_kit.extract.rollout.recorded.recorded_controller import Fitted
from probe_kit.extract.sources.recording import ACTION, STATE

_LONGEST = 12
"""Tasks and numbers that are listed."""
NAMED = 0.01
"""Share of unusual values of a number of the state, from which on it is named."""


def describe_recording(recording: Recording) -> dict[str, str]:
    """Format, episodes, frames, tasks and features of a data set, in words."""
    folder, lengths = recording.folder, [recording.folder.lengths[one] for one in recording.episodes]
    every = recording.source.every
    chosen = sum(-(-length // every) for length in lengths)
    texts = recording.instructions
    more = f" and {len(texts) - _LONGEST} more" if len(texts) > _LONGEST else ""
    return {
        "data set": recording.source.name + (f"@{folder.revision}" if folder.revision else ""),
        "frames per second": f"{folder.fps:g}",
        "episodes": f"{len(lengths)} of {len(folder.lengths)}, {_span(lengths)} frames each",
        "frames": f"{chosen} of {sum(lengths)} (every:{every})",
        "instructions": "; ".join(texts[:_LONGEST]) + more,
        "cameras": "; ".join(_camera(recording, feature) for feature in folder.cameras) or "none",
        STATE: _numbers(recording, STATE),
        ACTION: _numbers(recording, ACTION),
        "columns": ", ".join(folder.columns) or "none",
        "data sha": f"meta {folder.meta_blake2b[:12]}",
    }


def _span(lengths: Sequence[int]) -> str:
    least, most = min(lengths), max(lengths)
    return f"{least}" if least == most else f"{least} to {most}"


def describe_fit(fitted: Fitted) -> dict[str, str]:
    """How a model is shown the data set, in words."""
    recording, policy = fitted.recording, fitted.policy
    cameras = [f"{camera} from {feature}" for camera, feature in recording.source.cameras]
    masked = [camera for camera in policy.card.cameras if camera not in dict(recording.source.cameras)]
    chunk, width = fitted.prediction
    recorded = recording.folder.width(ACTION)
    return {
        "model": f"{policy.card.family}  weights {policy.card.weights_sha256[:12]}",
        "shown": "; ".join(cameras) + (f"; without a picture: {', '.join(masked)}" if masked else ""),
        "predicts": f"{chunk} actions of {width} numbers; the data set has {recorded or 'no actions'}"
        + (f" of {recorded} numbers" if recorded and recorded != width else ""),
        "actions": "not compared: " + fitted.other_actions
        if fitted.other_actions
        else "compared with the recorded ones, see `probe-kit run show RUN --action-errors`",
        "state": _shares(fitted),
    }


def _shares(fitted: Fitted) -> str:
    if not fitted.unusual.size:
        return "not compared: this model normalises no state"
    names = fitted.recording.folder.names(STATE)
    shares = [f"{names[one]} {share:.0%}" for one, share in enumerate(fitted.unusual) if share >= NAMED]
    return "outside the checkpoint's statistics: " + (
        ", ".join(shares[:_LONGEST]) or "less than 1 % of each number"
    )


def _camera(recording: Recording, feature: str) -> str:
    height, width = recording.folder.picture_shape(feature)
    return f"{feature} {width}×{height} ({recording.folder.encoding(feature)})"


def _numbers(recording: Recording, feature: str) -> str:
    width = recording.folder.width(feature)
    return "none" if width is None else f"{width} numbers: {', '.join(recording.folder.names(feature)[:_LONGEST])}"
