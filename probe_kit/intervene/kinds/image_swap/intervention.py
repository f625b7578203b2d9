"""Following: with the two pictures exchanged, and nothing else, does the action change sides?"""

from collections.abc import Sequence
from dataclasses import dataclass

from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.intervene.replay.conditions import Condition, Exchanged, Intervention, Plain
from probe_kit.intervene.replay.session import Bench


@dataclass(frozen=True, kw_only=True)
class Follow(Intervention):
    """Two inferences per episode, same state and noise: with its pictures, and with the two exchanged."""

    @property
    def kind(self) -> str:
        """`follow`."""
        return "follow"

    @property
    def needs(self) -> tuple[InterventionKind, ...]:
        """Two inferences that can be compared."""
        return ("follow",)

    def conditions(self, bench: Bench) -> Sequence[Condition]:
        """As the run made it, and exchanged."""
        del bench
        return Plain(), Exchanged()
