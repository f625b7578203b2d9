"""One row per run, category and view: behaviour, probes and retention side by side."""

from dataclasses import dataclass
from typing import Self

from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.rows.outcome_rules import OutcomeRuleScores
from probe_kit.retention.rows.parts import (
    ActionPeak,
    AnswerStats,
    BackbonePeak,
    Behaviour,
    ControlScores,
    RetentionScores,
    RunInfo,
    SwapEffect,
)
from probe_kit.train.results.control_scores import signal

MEAN = "mean"
"""Category of the rows that average over categories."""

Part = (
    RunInfo
    | Behaviour
    | SwapEffect
    | AnswerStats
    | OutcomeRuleScores
    | BackbonePeak
    | ActionPeak
    | RetentionScores
    | ControlScores
)


@dataclass(frozen=True, kw_only=True)
class RetentionRow(
    ControlScores,
    RetentionScores,
    ActionPeak,
    BackbonePeak,
    AnswerStats,
    OutcomeRuleScores,
    SwapEffect,
    Behaviour,
    RunInfo,
):
    """One line of the retention table: its parts, side by side under their own names.

    In a row of category `mean`, numbers are averages over `categories` and retention leaves out `left_out`.
    """

    category: str
    view: str | None
    group: str | None = None
    categories: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @classmethod
    def of(cls, category: str, view: str | None, group: str | None, *parts: Part) -> Self:
        """Put a row together; a part that is left out has nothing to say."""
        fields = {name: value for part in parts for name, value in vars(part).items()}
        return cls(category=category, view=view, group=group, **fields)

    @property
    def backbone_signal(self) -> bool:
        """Whether the backbone knows the answer: better than chance and every control that was run."""
        return bool(self.backbone_exceeds) and signal(self.backbone_exceeds)

    @property
    def action_signal(self) -> bool:
        """The same of the stream the action is made in."""
        return bool(self.action_exceeds) and signal(self.action_exceeds)

    @property
    def action_name(self) -> str:
        """What `action_stream` is called in a sentence."""
        return label_of(self.action_stream or "expert")
