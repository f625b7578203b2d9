"""What becomes of an episode, as the driver hears it: small enough to travel between processes."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Done:
    """Episode `number` is committed."""

    number: int
    outcome: dict[str, Any]


@dataclass(frozen=True)
class Failed:
    """Episode `number` went wrong."""

    number: int
    reason: str


Event = Done | Failed
