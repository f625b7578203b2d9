"""Events of an episode, as workers report them to the driver: small enough to send between processes."""

import traceback
from dataclasses import dataclass
from typing import Any

from probe_kit.errors import (
    ActionError,
    EmptyRoleError,
    InstructionError,
    NonFiniteActivationError,
    ObservationError,
    OwnEnvironmentError,
    PolicyFailedError,
    RecordingError,
    SceneError,
    StageDiedError,
)

# What one episode can get wrong by itself; everything else is wrong with the whole run and stops it.
EPISODE_ERRORS = (
    ActionError,
    EmptyRoleError,
    InstructionError,
    NonFiniteActivationError,
    ObservationError,
    OwnEnvironmentError,
    PolicyFailedError,
    RecordingError,
    SceneError,
    StageDiedError,
)


@dataclass(frozen=True)
class Done:
    """Episode `number` is committed."""

    number: int
    outcome: dict[str, Any]


@dataclass(frozen=True)
class Failed:
    """Episode `number` went wrong. traceback: of its error, empty if its process died."""

    number: int
    reason: str
    traceback: str = ""


Event = Done | Failed

LONGEST_TRACEBACK = 20_000
"""Characters of a traceback that are kept: its end, which names the error."""


def add_traceback(error: BaseException) -> None:
    """Store the traceback of `error` in the error itself, so that it survives being sent to another process."""
    error.__dict__["probe_kit_traceback"] = traceback_of(error)


def traceback_of(error: BaseException) -> str:
    """The traceback of `error`, after that of the process it was sent from."""
    local = "".join(traceback.format_exception(error))
    sent: str = error.__dict__.get("probe_kit_traceback", "")
    return (sent + local)[-LONGEST_TRACEBACK:]
