"""One row per run, category and view: behaviour, probes and retention side by side."""

from dataclasses import dataclass, field

from probe_kit.retention.behaviour.success_rate import SuccessRate
from probe_kit.retention.rows.outcome_rules import OutcomeRuleScores
from probe_kit.retention.rows.parts import (
    ActionPart,
    AnswerStats,
    BackbonePart,
    ControlScores,
    RetentionPart,
    RunInfo,
    SwapEffect,
)
from probe_kit.train.choices import CORRECT, SIDES, Task
from probe_kit.train.crossval.task_scores import METRICS

MEAN = "mean"
"""Category of the rows that average over categories."""


@dataclass(frozen=True, kw_only=True)
class RetentionRow:
    """One row of the retention table: its parts. A part with nothing to say holds defaults.

    view: how tokens became one vector, None without probes. target: what the probes decode; task:
    its kind. group: of several groups of runs, this run's. In a row
    of category `mean`, numbers are averages over `categories` and retention leaves out `left_out`.
    """

    category: str
    view: str | None
    target: str = CORRECT
    task: Task = "binary"
    group: str | None = None
    categories: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    run: RunInfo
    success: SuccessRate
    rules: OutcomeRuleScores = field(default_factory=OutcomeRuleScores)
    answers: AnswerStats = field(default_factory=AnswerStats)
    backbone: BackbonePart = field(default_factory=BackbonePart)
    action: ActionPart = field(default_factory=ActionPart)
    retention: RetentionPart = field(default_factory=RetentionPart)
    controls: ControlScores = field(default_factory=ControlScores)
    image_swap: SwapEffect = field(default_factory=SwapEffect)

    @property
    def key(self) -> tuple[str | None, str]:
        """Group and location of its run, which tell runs of a table apart."""
        return self.group, self.run.location

    @property
    def is_side(self) -> bool:
        """Whether the target is a side of a picture; success and answers are numbers of these rows alone."""
        return self.target in SIDES

    @property
    def metric(self) -> str:
        """The name of the score: accuracy balanced between classes, or R²."""
        return METRICS[self.task]
