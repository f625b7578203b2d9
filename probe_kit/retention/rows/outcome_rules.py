"""The outcome rule of a success rate, what it leaves unsaid, and what the other rules say."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from probe_kit.env.scoring import DEFAULT_RULE, RULES, rule_of
from probe_kit.errors import UsageError
from probe_kit.retention.behaviour import ask_of, capture_only, group_names, shares_of
from probe_kit.retention.estimators import Limits, limits
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.intervals import Share

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class OutcomeRuleScores:
    """The outcome rule, and what it gives away.

    rule, rule_words: by which all outcomes of the row are. last_steps: control steps at the end that it judged.
    n_answered, share_answered: episodes that ended in a zone; sr_answered: success among them. n_grasped,
    sr_grasped: the same of episodes in which both fingers ever touched the cube. share_unmoved_answers: share of
    answers whose cube never left its start. sr_idle: what a policy that does nothing would score; idle_side: the
    picture in whose zone the untouched cube then lies, `none`, or `both` where it differs between episodes.
    share_both_zones: share of episodes whose cube counts for both pictures, which is called correct. sr_by_rule:
    by every rule, at the last step. sr_by_epsilon: by zone radius in metres, for the rule `disc`. behaviour:
    shares of episodes by what hand and cube did. What is about answers is there for every run with a success rate;
    the rest is None or empty where the run keeps no trajectories.
    """

    rule: str = DEFAULT_RULE
    rule_words: str = ""
    last_steps: int = 1
    n_answered: int | None = None
    share_answered: float | None = None
    sr_answered: float | None = None
    sr_answered_ci: Limits | None = None
    n_grasped: int | None = None
    sr_grasped: float | None = None
    sr_grasped_ci: Limits | None = None
    share_unmoved_answers: float | None = None
    sr_idle: float | None = None
    idle_side: str | None = None
    share_both_zones: float | None = None
    sr_by_rule: dict[str, float] = field(default_factory=dict)
    sr_by_epsilon: dict[str, float] = field(default_factory=dict)
    behaviour: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class RunUnderRule:
    """A run by one rule. run: with its outcomes by that rule. verdicts, behaviour: None without trajectories."""

    run: RunReader
    rule: str
    words: str
    last_steps: int
    verdicts: "Mapping[str, pd.DataFrame] | None" = None
    behaviour: "pd.DataFrame | None" = None

    @classmethod
    def of(cls, run: RunReader, rule: str, last_steps: int = 1, with_behaviour: bool = True) -> Self:
        """Judge every episode by every rule, where the run keeps trajectories; answers in words have no rule.

        with_behaviour: False reads no trajectory for the rule whose outcomes are stored.
        """
        if ask_of(run) is not None:
            return cls(run, DEFAULT_RULE, "", 1)
        scene = run.settings.get("scene")
        words = "" if scene is None else rule_of(rule, scene).words
        is_stored = (rule, last_steps) == (DEFAULT_RULE, 1)
        if scene is None or run.episodes.empty or (is_stored and not with_behaviour) or not run.has_trajectories:
            return cls(run, rule, words, last_steps)
        judgeable: Any = run  # a run of `probe_kit.runs`, which keeps trajectories
        verdicts = {name: judgeable.judged(name) for name in RULES}
        return cls(judgeable.under(rule, last_steps), rule, words, last_steps, verdicts, judgeable.behaviour)

    @property
    def scored(self) -> bool:
        """Whether there is a success rate by this rule: by the default rule it was stored with every run."""
        return self.verdicts is not None or (self.rule, self.last_steps) == (DEFAULT_RULE, 1)

    def part(self, episodes: "pd.DataFrame") -> tuple[OutcomeRuleScores, dict[str, Share]]:
        """The row part of some of the episodes, whose index is their position in the run, and shares by name.

        Shares: `sr_answered` and `sr_grasped`, where they are defined.
        """
        identity: dict[str, Any] = {"rule": self.rule, "rule_words": self.words, "last_steps": self.last_steps}
        if not self.scored:
            return OutcomeRuleScores(**identity), {}
        answered = 1 - shares_of(episodes, "oob")
        shares = {"sr_answered": self._conditional(episodes, answered)}
        facts: dict[str, Any] = {
            "n_answered": int((episodes["outcome"] != "oob").sum()),
            "share_answered": float(answered.mean()),
        }
        if self.verdicts is not None and self.behaviour is not None:
            verdicts = {name: of_rule.loc[episodes.index] for name, of_rule in self.verdicts.items()}
            acted, by_rule = self.behaviour.loc[episodes.index], verdicts[self.rule]
            grasped = acted["grasped"].to_numpy(float)
            shares["sr_grasped"] = self._conditional(episodes, grasped)
            stayed = answered[~acted["moved"].to_numpy(bool)].sum()
            facts |= {
                "n_grasped": int(grasped.sum()),
                "share_unmoved_answers": float(stayed / answered.sum()) if answered.any() else None,
                "sr_idle": float((by_rule["idle"] == "correct").mean()),
                "idle_side": _idle_side(by_rule["idle"], episodes["side_correct"]),
                "share_both_zones": float(by_rule["both"].mean()),
                "sr_by_rule": {name: float(of_rule["correct"].mean()) for name, of_rule in verdicts.items()},
                "behaviour": _behaviour(acted),
            }
        defined = {name: share for name, share in shares.items() if share is not None}
        for name, share in defined.items():
            facts |= {name: share.value, f"{name}_ci": limits(share.interval())}
        return OutcomeRuleScores(**identity, **facts), defined

    def _conditional(self, episodes: "pd.DataFrame", weights: "NDArray[np.float64]") -> Share | None:
        """Success where the weights are, groups of items as the unit; None where there is no weight."""
        if not weights.any():
            return None
        counted = weights > 0
        # Of an episode judged by several steps the weight is a share too, and success is its part of that.
        right = np.divide(shares_of(episodes, "correct"), weights, out=np.zeros(weights.size), where=counted)
        return Share.of(right.clip(0, 1), group_names(episodes, self.run.seed_text), weights)


def _idle_side(idle: "pd.Series[str]", sides: "pd.Series[str]") -> str:
    """Return where the untouched cube lies, by the rule."""
    placed = {
        "none" if zone == "oob" else side if zone == "correct" else {"left": "right", "right": "left"}[side]
        for zone, side in zip(idle, sides, strict=True)
    }
    return placed.pop() if len(placed) == 1 else "both"


def _behaviour(acted: "pd.DataFrame") -> dict[str, float]:
    """Shares of episodes; of those that made a choice where there is one to make."""
    shares = {name: float(acted[name].mean()) for name in ("grasped", "moved", "released")}
    for name in ("first_choice", "closer_to", "release_near"):
        choices = acted[name][acted[name].isin(["correct", "wrong"])]
        shares[f"{name}_made"] = len(choices) / len(acted)
        if len(choices):
            shares[f"{name}_correct"] = float((choices == "correct").mean())
    shares["correct_side_share"] = float(acted["correct_side_share"].mean())
    return shares


def rule_sentence(rules: OutcomeRuleScores) -> str:
    """Return what outcomes were judged by, and what the rule gives away; for captions."""
    steps = f", mean of the last {rules.last_steps} control steps (all, where there are fewer)" * (
        rules.last_steps > 1
    )
    text = f"outcome rule {rules.rule}{f': {rules.rule_words}' if rules.rule_words else ''}{steps}"
    if rules.sr_idle is None:
        return text
    where = {
        "none": "the untouched cube lies in neither zone",
        "both": "the untouched cube lies in a zone of some episodes",
    }.get(
        rules.idle_side or "none", f"the untouched cube already lies in the zone of the {rules.idle_side} picture"
    )
    return f"{text}; a policy that does nothing would score {100 * rules.sr_idle:.1f} %, as {where}"


def can_be_judged(run: RunReader, rule: str, last_steps: int) -> bool:
    """Whether there are outcomes of a run by this rule; those by `disc` at the last step are always stored."""
    if (rule, last_steps) == (DEFAULT_RULE, 1) or ask_of(run) is not None or capture_only(run.episodes):
        return True
    return bool(run.has_trajectories)


def under_rule(run: RunReader, rule: str, last_steps: int = 1) -> RunReader:
    """The run with its outcomes by a rule, for figures; as it is where it cannot be judged."""
    if (rule, last_steps) == (DEFAULT_RULE, 1) or not run.has_trajectories:
        return run
    judged: RunReader = cast("Any", run).under(rule, last_steps)
    return judged


def check_epsilons(rule: str, are_set: bool) -> None:
    """Radii are those of the rule `disc`. Raises UsageError where they are asked for with another one."""
    if are_set and rule != DEFAULT_RULE:
        raise UsageError(f"zone radii belong to the outcome rule disc; {rule} has none. Leave out --epsilons")
