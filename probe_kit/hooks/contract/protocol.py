"""A published protocol for one family: one row of a table, declared by the family. Imports no torch."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, get_args

Rotation = Literal["roll-pitch-yaw", "axis-angle"]
"""What reaches the controller as the rotation of an action; see `ProtocolRow.rotation`."""
ROTATIONS: tuple[Rotation, ...] = get_args(Rotation)
PLAIN: Rotation = "roll-pitch-yaw"


@dataclass(frozen=True)
class ProtocolRow:
    """The settings with which a protocol uses a family.

    execute: actions executed per inference. options: of the family, whatever the checkpoint. of_checkpoint: the
    ones that only the protocol's own checkpoint needs. rotation: `roll-pitch-yaw` passes the angles of an action
    on; `axis-angle` passes axis times angle of the same turn on, which the controller then reads as angles.
    unmatched: what of the protocol cannot be done here. variant: which of several checkpoints it is, as in labels.
    alternatives: rows of the others; without a checkpoint, the row that holds them is used.
    """

    checkpoint: str
    execute: int
    dtype: str
    options: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    of_checkpoint: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    rotation: Rotation = PLAIN
    unmatched: tuple[str, ...] = ()
    variant: str = ""
    alternatives: "tuple[ProtocolRow, ...]" = ()

    @property
    def rows(self) -> "tuple[ProtocolRow, ...]":
        """The row itself and its alternatives."""
        return (self, *self.alternatives)

    def of(self, checkpoint: str | None) -> "ProtocolRow":
        """The row of `checkpoint`, at any revision.

        This one for None, and for a checkpoint that the protocol does not use.
        """
        return next((row for row in self.rows if row.checkpoint == _bare(checkpoint)), self)

    def options_for(self, checkpoint: str | None) -> dict[str, Any]:
        """The options with `checkpoint`, None for the protocol's own."""
        checkpoint_options = self.of_checkpoint if _bare(checkpoint) in (None, self.checkpoint) else {}
        return {**checkpoint_options, **self.options}

    def settings(self) -> dict[str, str]:
        """Every setting by name, as text; those of the family with -M in front."""
        return {
            "checkpoint": self.checkpoint,
            "execute": str(self.execute),
            "rotation": self.rotation,
            "dtype": self.dtype,
            **{f"-M {name}": as_text(value) for name, value in self.options_for(None).items()},
        }


def _bare(checkpoint: str | None) -> str | None:
    """A hub id without the revision at which it is read."""
    return None if checkpoint is None else checkpoint.partition("@")[0]


def as_text(value: Any) -> str:
    """An option's value as it is given on the command line."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


ProtocolName = Literal["act2answer"]
ACT2ANSWER: ProtocolName = "act2answer"
OWN_SEEDS = "draws come from the episode's seed; the release seeds once per process"
