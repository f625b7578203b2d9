"""Cameras, words and state of recordings against a checkpoint, in one message and before a network is loaded."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from probe_kit._system.bounded_files import read_regular
from probe_kit._system.bounded_json import parse_json
from probe_kit.errors import InstructionError, RecordingError
from probe_kit.extract.recordings.recorded_plan import Recording
from probe_kit.extract.sources.recording import IMAGES, STATE
from probe_kit.hooks.checkpoints.checkpoint import CONFIG_FILE
from probe_kit.hooks.family import Family

Check = Callable[[], object]
_EMPTY = "empty_camera"
"""Beginning of the name of a camera that never gets a picture."""


def declared_inputs(
    family: Family, checkpoint: str | None, options: Mapping[str, Any]
) -> tuple[tuple[str, ...], int | None] | None:
    """Cameras and numbers of the state that a checkpoint in lerobot's layout declares; None where none is here."""
    folder = family.folder_here(checkpoint, options)
    try:
        inputs = parse_json(read_regular(folder / CONFIG_FILE))["input_features"]
        cameras = [name.removeprefix(IMAGES) for name in inputs if name.startswith(IMAGES)]
        state = int(inputs[STATE]["shape"][0]) if STATE in inputs else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError):
        return None  # another layout; what it reads is known once it is loaded
    return tuple(name for name in cameras if not name.startswith(_EMPTY)), state


def raise_together(checks: Iterable[Check]) -> None:
    """Make all checks, and raise the error of one that fails, or one error that names those of all that fail."""
    errors: list[RecordingError | InstructionError] = []
    for check in checks:
        try:
            check()
        except (RecordingError, InstructionError) as error:
            errors.append(error)
    if len(errors) == 1:
        raise errors[0]
    if errors:
        listed = "\n".join(f"  {number}. {error}" for number, error in enumerate(errors, start=1))
        raise RecordingError(f"{len(errors)} things about the recordings do not fit the model:\n{listed}")


def check_state_width(recording: Recording, checkpoint: str, expected: int | None) -> None:
    """Raise RecordingError unless the recorded state has as many numbers as the model reads."""
    width = recording.folder.width(STATE)
    if expected is None or width == expected:
        return
    seen = "no " + STATE if width is None else f"{width} numbers as {STATE}"
    raise RecordingError(
        f"{recording.folder.path.name} has {seen}; {checkpoint} reads {expected}. Take the data set's own "
        "checkpoint, or a data set of this robot"
    )
