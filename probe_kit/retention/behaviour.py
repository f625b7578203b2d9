"""The behaviour of a run: success rate, answers and outcome rule, and its name among other runs."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from probe_kit._tables.numbers import Limits
from probe_kit.env.scoring import DEFAULT_RULE, RULES, SENSITIVITY_RADII, rule_of, success_at
from probe_kit.errors import UsageError
from probe_kit.retention.estimators import limits
from probe_kit.runs.array_run import ArrayRun
from probe_kit.runs.layout import CAPTURE_ONLY
from probe_kit.runs.reader import RunReader, check_several_wordings, full_name
from probe_kit.runs.run_inputs import notes_of_content
from probe_kit.runs.run_view import view_run
from probe_kit.statistics.intervals import Share
from probe_kit.statistics.paired_tests import heads_p
from probe_kit.statistics.significance import chance_margin
from probe_kit.train.choices import CORRECT, SIDES
from probe_kit.train.results.probe_results import ProbeResults, ProbeSettings

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray


# -- answers of a VLM ----------------------------------------------------------------------------------------

SCORES: Mapping[str, tuple[str, str]] = {
    "text": ("outcome", "side_placed"),
    "logits": ("outcome_logits", "side_logits"),
    "order-balanced": ("outcome_debiased", "side_debiased"),
}
"""The columns of outcome and side, by score."""

MANY_BY_CLAUSE = 0.05
"""Share of answers found among other words from which the accuracy without them is shown too."""


def read_by_clause(episodes: "pd.DataFrame", text: "pd.Series[str]") -> tuple[float, float | None]:
    """Return the share of answers that were found among other words, and the accuracy with these as unparsable.

    The accuracy is None where the share is `MANY_BY_CLAUSE` or less.

    Args:
        episodes: Episodes of a VLM, with the column `parse_tier`.
        text: Outcomes of the answers in text, one per episode.
    """
    in_clause = episodes["parse_tier"] == "clause"
    share = float(in_clause.mean())
    return share, float(((text == "correct") & ~in_clause).mean()) if share > MANY_BY_CLAUSE else None


def scored(run: RunReader, score: str, with_side_words: bool = False) -> RunReader:
    """Return a view of a VLM run by a score, in place of any that it was read by; a policy run stays as it is.

    Its episodes have `outcome` and `side_placed` by the score; the column `outcome_text` has the outcomes by text.

    Args:
        run: The run of a VLM or of a policy.
        score: A key of `SCORES`.
        with_side_words: Keep items in whose name a side stands, such as "no left turn sign": answers and names of
            these are not distinguishable.

    Raises:
        UsageError: For an unknown score.
    """
    if score not in SCORES:
        raise UsageError(f"score is {score!r}; expected one of {', '.join(SCORES)}")
    if run.ask is None:
        return run
    unscored = run if run.viewed is None else run.viewed
    episodes = unscored.episodes
    if not with_side_words and "side_word" in episodes:
        episodes = episodes[~episodes["side_word"].astype(bool)]
    outcome, side = SCORES[score]
    by_score = episodes.assign(
        outcome_text=episodes["outcome"], outcome=episodes[outcome], side_placed=episodes[side]
    )
    return view_run(unscored, by_score, score=score)


def left_out(runs: Sequence[RunReader]) -> list[str]:
    """Return a sentence per VLM run whose items with side words are not counted."""
    return [
        f"{run.location}: {missing} episodes are left out because a side stands in the name that was asked for, "
        "such as 'no left turn sign' (--with-side-words counts them)."
        for run in runs
        if run.viewed is not None and (missing := len(run.viewed.episodes) - len(run.episodes))
    ]


# -- success -------------------------------------------------------------------------------------------------


class Regime(StrEnum):
    """The three readings of a success rate: how far knowledge reaches the action."""

    KNOWLEDGE = "evidence of usable knowledge"
    NO_RELIABLE_KNOWLEDGE = "no reliable usable knowledge"
    FAILURE = "instruction or perceptual failure"


@dataclass(frozen=True)
class PairedItems:
    """Items that ran in both layouts, counted by how many of the two were right.

    Attributes:
        both: Items right in both layouts.
        exactly_one: Items right in one layout.
        none: Items right in no layout.
        both_wrong: Items wrong twice, part of `none`.
        p: Exact one-sided p of groups with more of `both` against groups with more of `both_wrong`. A side bias of
            any strength makes them equally likely, and items that share a picture count once.
    """

    both: int
    exactly_one: int
    none: int
    both_wrong: int
    p: float


@dataclass(frozen=True, kw_only=True)
class SuccessRate:
    """Outcomes of the episodes of one category (or of any table of episodes); rates are shares, 0 to 1.

    A rate over no episodes is None, and so is every rate of a model that did not act.

    Attributes:
        n_groups: Independent groups of items.
        ci: 95 % interval of `sr`, groups of items as the unit (`Share.interval`).
        sr_original: Rate in the original layout.
        sr_swapped: Rate in the swapped layout.
        layout_mean: Mean of the rates of both layouts.
        sr_left: Rate of episodes whose correct picture is on the left.
        sr_right: Rate of episodes whose correct picture is on the right.
        share_wrong: Share that ended on the other picture.
        share_outside: Share that ended on neither picture.
        share_never_moved: Share that ended where it started, a failed grasp; part of `share_outside`, None if it
            was not recorded.
        share_invalid_action: Share of inferences that put out no action, None for a policy that cannot tell.
        chance_margin_episodes: Half-width of the band around 0.5 that guessing explains, for N = episodes (the
            paper's).
        chance_margin_items: The same for N = items.
        chance_margin: The same for as many items as count, fewer where items of a group answer alike; `regime` is
            judged by it.
        reason: Reason of the regime, or reason why there is no rate.
        side_preference: Share placed left among episodes placed in a zone.
        normalised_score: Only of a mean over categories.
    """

    n_episodes: int
    n_items: int
    n_groups: int | None = None
    sr: float | None = None
    ci: tuple[float | None, float | None] | None = None
    sr_original: float | None = None
    sr_swapped: float | None = None
    layout_mean: float | None = None
    sr_left: float | None = None
    sr_right: float | None = None
    share_wrong: float | None = None
    share_outside: float | None = None
    share_never_moved: float | None = None
    share_invalid_action: float | None = None
    chance_margin_episodes: float | None = None
    chance_margin_items: float | None = None
    chance_margin: float | None = None
    regime: Regime | None = None
    reason: str = ""
    side_preference: float | None = None
    normalised_score: float | None = None
    paired: PairedItems | None = None


def regime(
    sr: float, margin: float, share_wrong: float, share_outside: float, answers: bool = False
) -> tuple[Regime, str]:
    """Return the regime of a success rate, and the reason in a few words.

    Args:
        sr: Success rate, 0 to 1.
        margin: Half-width of the band around 0.5 that guessing explains.
        share_wrong: Share of episodes that ended on the wrong picture.
        share_outside: Share of episodes that ended on neither (`oob`); of answers, those that could not be read.
        answers: Whether the rate is one of answers in words.
    """
    share = "accuracy" if answers else "SR"
    if sr > 0.5 + margin:
        return Regime.KNOWLEDGE, f"{share} {sr:.3f} is above 0.5 + Δ = {0.5 + margin:.3f}"
    if sr >= 0.5 - margin:
        return Regime.NO_RELIABLE_KNOWLEDGE, f"{share} {sr:.3f} is within 0.5 ± Δ = {margin:.3f}"
    nowhere = "no answer could be read in" if answers else "the cube ends outside both zones in"
    cause = (
        f"{nowhere} {share_outside:.0%} of episodes"
        if share_outside >= share_wrong
        else f"the wrong picture is chosen in {share_wrong:.0%} of episodes"
    )
    return Regime.FAILURE, f"{share} {sr:.3f} is below 0.5 − Δ = {0.5 - margin:.3f}: {cause}"


def normalised_score(success_rates: Sequence[float]) -> float:
    """Return the mean success rate over categories on a scale where guessing is 0 and perfection 100."""
    if not success_rates:
        raise UsageError("the normalised score needs the success rate of at least one category")
    return (100 * fmean(success_rates) - 50) / 50 * 100


def capture_only(episodes: "pd.DataFrame") -> bool:
    """Whether the model of these episodes only captured: it did not act, and there is no success rate.

    False for episodes without a column `outcome`, such as those of arrays of your own.
    """
    if episodes.empty or "outcome" not in episodes:
        return False
    return bool((episodes["outcome"] == CAPTURE_ONLY).all())


def _check_acted(episodes: "pd.DataFrame") -> None:
    if capture_only(episodes):
        raise UsageError("this run's model was captured (extract --no-act): there is no success rate, only probes")


def shares_of(episodes: "pd.DataFrame", outcome: str) -> "NDArray[np.float64]":
    """Return the share (E,) of each episode that had this outcome.

    It is 0 or 1, or a share where several last steps were judged.
    """
    name = f"share_{outcome}"
    if name in episodes:
        return episodes[name].to_numpy(dtype=np.float64)
    return (episodes["outcome"] == outcome).to_numpy().astype(np.float64)


def _correct(episodes: "pd.DataFrame") -> "pd.Series[float]":
    import pandas as pd

    return pd.Series(shares_of(episodes, "correct"), index=episodes.index)


def success_share(episodes: "pd.DataFrame", seed_text: str = "") -> Share:
    """Return the SR with groups of items as the unit; the run's `seed_text` separates groups of several suites."""
    return Share.of(shares_of(episodes, "correct"), group_names(episodes, seed_text))


def group_names(episodes: "pd.DataFrame", seed_text: str) -> "NDArray[np.str_]":
    """Return the groups of items (E,), named after the questions of their suite too."""
    return np.char.add(f"{seed_text}/", units_of(episodes))


def success_rate(episodes: "pd.DataFrame") -> SuccessRate:
    """Return the success rate and related numbers for a table of episodes.

    Args:
        episodes: Columns `item_id`, `layout`, `side_correct`, `outcome` (`correct`, `wrong`, `oob`),
            `side_placed`, and `group_id` where items share pictures. Where the last steps of an episode were
            averaged also `share_correct` and so on, which the pairs of items take no notice of. Optional are
            `never_moved`, `flagged_steps` with `inferences`, and `parse` of answers.

    Raises:
        UsageError: For a table that is empty or of several wordings, and for episodes in which the model did not
            act.
    """
    check_several_wordings(episodes)
    _check_acted(episodes)
    if episodes.empty:
        raise UsageError("no finished episodes: there is no success rate. Finish the extraction first.")
    correct = _correct(episodes)
    sr, share_wrong = float(correct.mean()), float(shares_of(episodes, "wrong").mean())
    share_outside = float(shares_of(episodes, "oob").mean())
    n_items = int(episodes["item_id"].nunique())
    margin = chance_margin(independent_items(episodes))
    name, reason = regime(sr, margin, share_wrong, share_outside, "parse" in episodes)
    interval = success_share(episodes).interval()
    if name == Regime.KNOWLEDGE and interval.low <= 0.5:
        name, reason = Regime.NO_RELIABLE_KNOWLEDGE, f"{reason}, but its 95 % interval includes one half"
    original, swapped = (_rate(correct[episodes["layout"] == layout]) for layout in ("original", "swapped"))
    placed = episodes["side_placed"][episodes["outcome"] != "oob"]
    return SuccessRate(
        n_episodes=len(episodes),
        n_items=n_items,
        n_groups=np.unique(units_of(episodes)).size,
        sr=sr,
        ci=(interval.low, interval.high),
        sr_original=original,
        sr_swapped=swapped,
        layout_mean=None if original is None or swapped is None else (original + swapped) / 2,
        sr_left=_rate(correct[episodes["side_correct"] == "left"]),
        sr_right=_rate(correct[episodes["side_correct"] == "right"]),
        share_wrong=share_wrong,
        share_outside=share_outside,
        share_never_moved=_rate(episodes["never_moved"].astype(bool)) if "never_moved" in episodes else None,
        share_invalid_action=_flagged_share(episodes),
        chance_margin_episodes=chance_margin(len(episodes)),
        chance_margin_items=chance_margin(n_items),
        chance_margin=margin,
        regime=name,
        reason=reason,
        side_preference=_rate(placed == "left"),
        paired=paired_items(episodes),
    )


def _flagged_share(episodes: "pd.DataFrame") -> float | None:
    """Return the share of inferences that were flagged; every inference counts once, whatever its episode."""
    if not {"flagged_steps", "inferences"} <= set(episodes):
        return None
    return float(episodes["flagged_steps"].sum() / episodes["inferences"].sum())


def units_of(episodes: "pd.DataFrame") -> "NDArray[np.str_]":
    """Return the units (E,) that are drawn as a whole.

    A unit is the group of items that share pictures, or the item where no group is known.
    """
    return episodes["group_id" if "group_id" in episodes else "item_id"].to_numpy(dtype=str)


def independent_items(episodes: "pd.DataFrame") -> float:
    """Return how many items the success rate rests on: all, or fewer where those of a group answer alike.

    It is the number of items divided by the ratio of two variations of the success rate: between groups, and as if
    the items of a group had nothing in common.
    """
    correct = _correct(episodes)
    residual = correct - correct.mean()
    by_item = float((residual.groupby(episodes["item_id"]).sum() ** 2).sum())
    by_group = float((residual.groupby(units_of(episodes)).sum() ** 2).sum())
    items = int(episodes["item_id"].nunique())
    return items if by_group <= by_item else items * by_item / by_group


def sensitivity(episodes: "pd.DataFrame", radii: Sequence[float] = SENSITIVITY_RADII) -> dict[float, float]:
    """Return the success rate by zone radius ε in metres, from where the cube ended: no episode runs again.

    Empty for a table without the columns.

    Args:
        episodes: Columns `distance_correct` and `distance_wrong`, metres; missing where the simulator broke, which
            is no success.
        radii: Zone radii in metres.

    Raises:
        SceneError: For a radius with overlapping zones.
    """
    columns = ["distance_correct", "distance_wrong"]
    if not set(columns) <= set(episodes):
        return {}
    distances = [(correct, wrong) for correct, wrong in episodes[columns].astype(float).to_numpy()]
    return {radius: success_at(distances, radius) for radius in radii}


def paired_items(episodes: "pd.DataFrame") -> PairedItems:
    """Return the items that ran in both layouts, by outcome; others are left out.

    Raises:
        UsageError: If the model did not act, and for an item that occurs twice in one layout.
    """
    _check_acted(episodes)
    group_of = dict(zip(episodes["item_id"], units_of(episodes), strict=True))
    trials = zip(episodes["item_id"], episodes["layout"], strict=True)
    outcome_of = dict(zip(trials, episodes["outcome"], strict=True))
    if len(outcome_of) < len(episodes):
        raise UsageError("an item occurs twice in one layout; expected one episode each. Select one of them")
    by_item = {item: [outcome_of.get((item, layout)) for layout in ("original", "swapped")] for item in group_of}
    pairs = {item: pair for item, pair in by_item.items() if all(isinstance(outcome, str) for outcome in pair)}
    right = Counter(pair.count("correct") for pair in pairs.values())
    lead: Counter[str] = Counter()
    for item, pair in pairs.items():
        lead[group_of[item]] += (pair.count("correct") == 2) - (pair.count("wrong") == 2)
    favoured = [votes for votes in lead.values() if votes]  # groups that favour neither are no tosses
    return PairedItems(
        both=right[2],
        exactly_one=right[1],
        none=right[0],
        both_wrong=sum(pair.count("wrong") == 2 for pair in pairs.values()),
        p=heads_p(sum(votes > 0 for votes in favoured), len(favoured)),
    )


def _rate(values: "pd.Series[bool] | pd.Series[float]") -> float | None:
    return float(values.mean()) if len(values) else None


# -- names and settings of the runs of a table ---------------------------------------------------------------

_MARKS: Sequence[Callable[[RunReader, int], str]] = (
    lambda run, _: run.settings_sha256[:6],
    lambda run, _: run.location.name,
    lambda _, number: str(number),
)
"""The marks that are added one after the other to a name that comes twice: settings, folder, number."""


def distinct_labels(runs: Sequence[RunReader], names: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the label of each run by its location, so that no two full names are equal.

    Runs of one name get the hash of their settings, where that is the same their folders, and else a number.

    Args:
        runs: Runs of one table.
        names: Labels by location instead of the runs' own.

    Raises:
        UsageError: For a label of a run that is none of these.
    """
    labels = {str(run.location): run.label for run in runs}
    if unknown := sorted((names or {}).keys() - labels.keys()):
        raise UsageError(f"labels are given for {', '.join(unknown)}; the runs are {', '.join(labels)}")
    labels |= names or {}
    for mark in _MARKS:
        doubles = _doubles(runs, labels)
        for number, run in enumerate(runs, 1):
            if str(run.location) in doubles:
                labels[str(run.location)] += f" · {mark(run, number)}"
    return labels


def _doubles(runs: Sequence[RunReader], labels: Mapping[str, str]) -> set[str]:
    """Return the locations of runs whose full names are equal."""
    names = {
        str(run.location): full_name(labels[str(run.location)], run.random_weights, capture_only(run.episodes))
        for run in runs
    }
    often = Counter(names.values())
    return {location for location, name in names.items() if often[name] > 1}


_COMPARED: Mapping[str, Callable[[ProbeSettings], str]] = {
    "targets": lambda settings: settings.target,
    "views": lambda settings: ", ".join(settings.views),
    "label permutations": lambda settings: str(settings.permutations),
    "label permutations of token views": lambda settings: str(settings.token_permutations),
    "captured inferences": lambda settings: str(settings.call),
    "seeds": lambda settings: str(settings.seed),
    "categories": lambda settings: ", ".join(settings.categories),
}


def without_content(runs: Sequence[RunReader]) -> list[str]:
    """Return a sentence for every input of some runs without content, such as a black camera."""
    return [
        f"{run.label}: {note}. Scores of its probes are no evidence."
        for run in runs
        for note in notes_of_content(run)
    ]


def mixed_episodes(runs: Sequence[RunReader]) -> list[str]:
    """Return a sentence for every run whose episodes were not all made by the same device kind and versions."""
    return [
        f"{run.location} is mixed: its episodes were made with other {', '.join(mixed)}, which changes numbers "
        "(--allow-mixed)."
        for run in runs
        if (mixed := run.mixed)
    ]


def chosen_wordings(runs: Sequence[RunReader]) -> list[str]:
    """Return a sentence for every run that was asked in several wordings: which one its rows are of."""
    return [
        f"Rows of {run.location} are of the wording {run.episodes['wording'].iloc[0]!r}; it was asked in "
        f"{', '.join(names)} (--wording)."
        for run in runs
        if (names := run.wordings)
    ]


def mixed_settings(
    results: Mapping[tuple[str, str], ProbeResults], views: Sequence[str] | None = None
) -> list[str]:
    """Return a sentence if probes of several runs were not fitted alike, and one per target other than the answer.

    Args:
        results: Probe results by the location of the run and the target.
        views: Views that are shown, if not all are; then it does not matter which others there are.
    """
    differences = []
    for name, value in _COMPARED.items():
        if name == "views" and views is not None:
            continue
        runs: dict[str, list[str]] = {}
        for (run, _), probes in results.items():
            runs.setdefault(value(probes.settings), []).append(Path(run).name)
        if len(runs) > 1:
            parts = (f"{setting} ({', '.join(names)})" for setting, names in runs.items())
            differences.append(f"{name} {' against '.join(parts)}")
    labels = {probes.settings.target for probes in results.values()} - {CORRECT}
    notes = [f"Probes were asked for the target {label!r}: {SIDES[label]}." for label in sorted(labels)]
    calls = {probes.settings.call for probes in results.values()} - {0}
    notes += [f"Probes are of captured inference {call}, counted from 0." for call in sorted(calls)]
    if not differences:
        return notes
    return [
        *notes,
        f"The rows mix probe settings: {'; '.join(differences)}. Compare them with care, or fit all runs alike; "
        "`probe-kit run show RUN` lists what a run has, --probes RUN=KEY chooses.",
    ]


# -- the outcome rule -----------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class OutcomeRuleScores:
    """The outcome rule, and the success that it grants without skill.

    Numbers about answers are there for every run with a success rate. The others are None or empty where the run
    keeps no trajectories.

    Attributes:
        rule: The rule by which all outcomes of the row are judged.
        rule_words: The rule in words.
        last_steps: Control steps at the end that it judged.
        n_answered: Number of episodes that ended in a zone.
        share_answered: Share of episodes that ended in a zone.
        sr_answered: Success among them.
        n_grasped: Number of episodes in which both fingers ever touched the cube.
        sr_grasped: Success among those.
        share_unmoved_answers: Share of answers whose cube never left its start.
        sr_idle: Success rate that a policy would score that does nothing.
        idle_side: The picture in whose zone the untouched cube then lies, `none`, or `both` where it differs
            between episodes.
        share_both_zones: Share of episodes whose cube counts for both pictures, which is called correct.
        sr_by_rule: Success rate by every rule, at the last step.
        sr_by_epsilon: Success rate by zone radius in metres, for the rule `disc`.
        behaviour: Shares of episodes by the behaviour of hand and cube.
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
class TableRun:
    """A run in the form that a table reads: by a score, by an outcome rule, and under a name of its own.

    Attributes:
        run: The run, by its score if it was asked.
        judged: The run with its outcomes by the rule; the same as `run` where there is nothing to judge by.
        label: Its name without marks.
        group: The group of runs that it belongs to, if there are several.
        words: The rule in words.
        last_steps: Control steps at the end that are judged.
        verdicts: By rule, a row per episode; None without trajectories.
        behaviour: A row per episode; None without trajectories.
    """

    run: RunReader
    judged: RunReader
    label: str
    group: str | None = None
    rule: str = DEFAULT_RULE
    words: str = ""
    last_steps: int = 1
    verdicts: "Mapping[str, pd.DataFrame] | None" = None
    behaviour: "pd.DataFrame | None" = None

    @classmethod
    def of(
        cls,
        run: RunReader,
        rule: str = DEFAULT_RULE,
        last_steps: int = 1,
        with_behaviour: bool = True,
        *,
        label: str | None = None,
        group: str | None = None,
    ) -> Self:
        """Judge every episode by every rule, where the run keeps trajectories; answers in words have no rule.

        Args:
            run: The run, already by its score if it was asked.
            rule: Name of the outcome rule.
            last_steps: Control steps at the end that are judged.
            with_behaviour: False reads no trajectory for the rule whose outcomes are stored.
            label: Name of the run in the table; by default its own label.
            group: The group of runs that it belongs to; None for none.
        """
        label = run.label if label is None else label
        if run.ask is not None:
            return cls(run, run, label, group)
        scene = run.settings.get("scene")
        words = "" if scene is None else rule_of(rule, scene).words
        is_stored = (rule, last_steps) == (DEFAULT_RULE, 1)
        if (
            isinstance(run, ArrayRun)
            or scene is None
            or run.episodes.empty
            or (is_stored and not with_behaviour)
            or not run.has_trajectories
        ):
            return cls(run, run, label, group, rule, words, last_steps)
        verdicts = {name: run.judged(name) for name in RULES}
        judged = run.under(rule, last_steps)
        return cls(run, judged, label, group, rule, words, last_steps, verdicts, run.behaviour)

    @property
    def location(self) -> str:
        """The folder or URL of the run."""
        return str(self.run.location)

    @property
    def name(self) -> str:
        """The label, marked if the weights are random or the model did not act; its group in front."""
        name = full_name(self.label, self.run.random_weights, self.is_captured_only)
        return name if self.group is None else f"{self.group}: {name}"

    @property
    def answers(self) -> bool:
        """Whether its model was asked and did not act."""
        return self.run.ask is not None

    @cached_property
    def is_captured_only(self) -> bool:
        """Whether its model was captured and did not act."""
        return capture_only(self.run.episodes)

    @property
    def is_judged(self) -> bool:
        """Whether there is a success rate by this rule: by the default rule it was stored with every run."""
        if self.is_captured_only:
            return False
        return self.verdicts is not None or (self.rule, self.last_steps) == (DEFAULT_RULE, 1)

    def part(self, episodes: "pd.DataFrame") -> tuple[OutcomeRuleScores, dict[str, Share]]:
        """Return the outcome-rule part of a row for some of the episodes, and shares by name.

        The shares are `sr_answered` and `sr_grasped`, where they are defined.

        Args:
            episodes: Episodes whose index is their position in the run.
        """
        identity: dict[str, Any] = {"rule": self.rule, "rule_words": self.words, "last_steps": self.last_steps}
        if not self.is_judged:
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
        """Return the success where the weights are, groups of items as the unit; None where there is no weight."""
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
    """Return shares of episodes; for choices, of the episodes that made one."""
    shares = {name: float(acted[name].mean()) for name in ("grasped", "moved", "released")}
    for name in ("first_choice", "closer_to", "release_near"):
        choices = acted[name][acted[name].isin(["correct", "wrong"])]
        shares[f"{name}_made"] = len(choices) / len(acted)
        if len(choices):
            shares[f"{name}_correct"] = float((choices == "correct").mean())
    shares["correct_side_share"] = float(acted["correct_side_share"].mean())
    return shares


def rule_sentence(rules: OutcomeRuleScores) -> str:
    """Return the rule that judged the outcomes, and the success that it grants without skill; for captions."""
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


def check_epsilons(rule: str, are_set: bool) -> None:
    """Raise UsageError where zone radii are set for another rule than `disc`, to which they belong."""
    if are_set and rule != DEFAULT_RULE:
        raise UsageError(f"zone radii belong to the outcome rule disc; {rule} has none. Leave out --epsilons")
