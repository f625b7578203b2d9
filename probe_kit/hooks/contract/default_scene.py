"""The scene in which a model acts if none is given. Imports no environment: names and values only."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True)
class DefaultScene:
    """preset: of `SceneSpec.preset`. changes: its fields that differ, also when other fields are asked for."""

    preset: str
    changes: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    def __str__(self) -> str:
        """The preset and its changes, as `probe-kit models` shows them."""
        return ", ".join([self.preset, *(f"{name} {value}" for name, value in self.changes.items())])


RELEASED = DefaultScene("act2answer")
"""Of every family that declares no other: policies and VLMs of one study get the same first frames."""
EMBEDDED = DefaultScene("act2answer", MappingProxyType({"early_stop": True, "max_steps": 40}))
"""Of the embedded models, whose demonstrations took at most 40 actions."""
