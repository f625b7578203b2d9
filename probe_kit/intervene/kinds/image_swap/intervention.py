"""Image swap: with the two images swapped, and nothing else, does the action change sides?"""

from collections.abc import Sequence
from dataclasses import dataclass

from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.intervene.replay.conditions import CleanRun, Condition, ImagesSwapped, Intervention
from probe_kit.intervene.replay.session import ReplaySession


@dataclass(frozen=True, kw_only=True)
class ImageSwap(Intervention):
    """Two inferences per episode, same state and noise: clean, and with the two images swapped."""

    @property
    def kind(self) -> str:
        """`image-swap`."""
        return "image-swap"

    @property
    def required_capabilities(self) -> tuple[InterventionKind, ...]:
        """Two inferences that can be compared."""
        return ("swap",)

    def conditions(self, session: ReplaySession) -> Sequence[Condition]:
        """Clean, and with swapped images."""
        del session
        return CleanRun(), ImagesSwapped()
