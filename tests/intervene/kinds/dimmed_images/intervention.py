"""What is done: one inference per share of the contrast."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from probe_kit.hooks.contract.interventions import InterventionKind
from probe_kit.intervene.replay.conditions import (
    CleanRun,
    Condition,
    ConditionContext,
    ConditionResult,
    Intervention,
)
from probe_kit.intervene.replay.session import ReplaySession


@dataclass(frozen=True, kw_only=True)
class DimmedImages(Intervention):
    """The same state, noise and instruction with less contrast. coefficients: shares of it that stay."""

    coefficients: tuple[float, ...] = (0.0,)

    @property
    def kind(self) -> str:
        """`dimmed-images`."""
        return "dimmed-images"

    @property
    def required_capabilities(self) -> tuple[InterventionKind, ...]:
        """Two inferences that can be compared."""
        return ("swap",)

    def parameters(self) -> dict[str, Any]:
        """How much contrast stays."""
        return {"coefficients": list(self.coefficients)}

    def conditions(self, session: ReplaySession) -> Sequence[Condition]:
        """As in the run, then every share."""
        del session
        return CleanRun(), *(Dimmed(share) for share in self.coefficients)


@dataclass(frozen=True)
class Dimmed:
    """The image with a share of its contrast."""

    share: float

    @property
    def name(self) -> str:
        """Its share."""
        return f"dimmed-{self.share:g}"

    def play(self, context: ConditionContext) -> ConditionResult:
        """Only the image is another."""
        seen, seed = context.replay_input.seen, context.replay_input.seed
        image = np.uint8(128 + self.share * (seen.image.astype(np.float64) - 128))
        return ConditionResult(context.session.act(replace(seen, image=image), seed))
