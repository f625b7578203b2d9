"""Following: with the two pictures exchanged, and nothing else, does the action change sides?"""

from collections.abc import Sequence
from dataclasses import dataclass

from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.intervene.replay.conditions import CleanRun, Condition, ImagesSwapped, Intervention
from probe_kit.intervene.replay.session import ReplaySession


@dataclass(frozen=True, kw_only=True)
class ImageSwap(Intervention):
    """Two inferences per episode, same state and noise: with its pictures, and with the two exchanged."""

    @property
    def kind(self) -> str:
        """`follow`."""
        return "follow"

    @property
    def required_capabilities(self) -> tuple[InterventionKind, ...]:
        """Two inferences that can be compared."""
        return ("swap",)

    def conditions(self, session: ReplaySession) -> Sequence[Condition]:
        """As the run made it, and exchanged."""
        del session
        return CleanRun(), ImagesSwapped()
