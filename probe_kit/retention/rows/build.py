"""The rows of one run and their mean, with the estimates that averages and differences are made of."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from operator import attrgetter
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit.env.scoring import DEFAULT_RULE
from probe_kit.errors import UnknownSiteError
from probe_kit.intervene.evidence import StoredEvidence, stored_ties
from probe_kit.retention.behaviour import (
    SuccessRate,
    ask_of,
    capture_only,
    normalised_score,
    read_by_clause,
    sensitivity,
    success_rate,
    success_share,
    units_of,
)
from probe_kit.retention.choices import Iterations
from probe_kit.retention.estimators import ACTION, BACKBONE, Limits, Rate, StreamScores, limits
from probe_kit.retention.rows.outcome_rules import OutcomeRuleScores, RunUnderRule
from probe_kit.retention.rows.probe_parts import number_or_none, with_probes
from probe_kit.retention.rows.row import (
    MEAN,
    ActionPart,
    AnswerStats,
    BackbonePart,
    ControlScores,
    RetentionPart,
    RetentionRow,
    RunInfo,
    SwapEffect,
)
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.intervals import Share
from probe_kit.statistics.retention import Scores, retention
from probe_kit.statistics.sufficiency import ABSENT_BELOW
from probe_kit.train.choices import CORRECT
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class RowWithEstimates:
    """A row and the estimates behind its numbers.

    rates: shares of episodes by name, such as `sr`. streams: scores, None without probes. outcomes: the episodes
    of its success rate, if it has one.
    """

    row: RetentionRow
    rates: Mapping[str, Share] = field(default_factory=dict)
    streams: StreamScores | None = None
    outcomes: "pd.DataFrame | None" = None


@dataclass(frozen=True)
class RowSettings:
    """The settings of a table.

    epsilons: zone radii in metres for `sr_by_epsilon`, which belong to the rule `disc`. rule, last_steps: see
    `probe_kit.env.scoring.judge`. absent_below: accuracy below which a stream's best site counts as absent.
    with_behaviour: see `RunUnderRule.of`.
    """

    views: Sequence[str] | None
    iterations: Iterations
    epsilons: Sequence[float]
    rule: str = DEFAULT_RULE
    last_steps: int = 1
    absent_below: float = ABSENT_BELOW
    categories: Sequence[str] | None = None
    with_behaviour: bool = True


def run_rows(
    run: RunReader, results: ProbeResults | None, settings: RowSettings, group: str | None = None
) -> list[RowWithEstimates]:
    """One row per category and view of `run`, in the order of its episodes; without `results`, success rates only.

    Raises UnknownSiteError for a view that was not probed.
    """
    views: Sequence[str | None] = (None,) if results is None else settings.views or results.settings.views
    if results is not None and (unknown := set(settings.views or ()) - set(results.settings.views)):
        probed = ", ".join(results.settings.views)
        raise UnknownSiteError(f"{run.location} has probes of {probed}, not of {', '.join(sorted(unknown))}")
    judged = RunUnderRule.of(run, settings.rule, settings.last_steps, settings.with_behaviour)
    evidence = StoredEvidence(run)
    ties = {view: stored_ties(evidence, results, view) if evidence.swaps else {} for view in views}
    drawn = [
        _row(judged, results, settings, group, str(category), episodes, view)
        for category, episodes in judged.run.episodes.groupby("category", sort=False)
        if settings.categories is None or category in settings.categories
        for view in views
    ]
    return [
        replace(row, row=add_image_swap(row.row, evidence, ties[row.row.view].get(row.row.category, "")))
        for row in drawn
    ]


def _row(
    judged: RunUnderRule,
    results: ProbeResults | None,
    settings: RowSettings,
    group: str | None,
    category: str,
    episodes: "pd.DataFrame",
    view: str | None,
) -> RowWithEstimates:
    run, heard = judged.run, capture_only(episodes)
    scored = judged.scored and not heard
    success = success_rate(episodes) if scored else _no_success(episodes, heard)
    rules = OutcomeRuleScores(rule=judged.rule, rule_words=judged.words)
    rates, streams = dict[str, Share](), None
    if scored:
        radii = settings.epsilons if settings.rule == DEFAULT_RULE else ()
        by_radius = {f"{radius:g}": rate for radius, rate in sensitivity(episodes, radii).items()}
        rules, shares = judged.part(episodes)
        rules = replace(rules, sr_by_epsilon=by_radius)
        rates = {"sr": success_share(episodes, run.seed_text), **shares}
    row = RetentionRow(
        category=category,
        view=view,
        target=CORRECT if results is None else results.settings.target,
        group=group,
        run=RunInfo.of(run, results),
        success=success,
        rules=rules,
        answers=_answers(run, episodes),
    )
    if results is not None and view is not None:
        row, streams = with_probes(row, results, settings.iterations, settings.absent_below, run.seed_text)
    return RowWithEstimates(row, rates, streams, episodes if scored else None)


def add_image_swap(row: RetentionRow, evidence: StoredEvidence, tie: str = "") -> RetentionRow:
    """The row with the effect of the image swap on its category, judged by its own probes.

    tie: of the row's category and view, see `evidence.stored_ties`.
    """
    of_category = evidence.swaps.get(row.category)
    if of_category is None:
        return row
    encoded = row.backbone.has_signal if row.backbone.exceeds else None
    effect = SwapEffect(
        follow_rate=of_category.follow_rate,
        reversal_rate=of_category.reversal_rate,
        net_follow_rate=of_category.net_follow_rate,
        net_follow_rate_ci=of_category.net_follow_rate_ci,
        reach_share=of_category.reach_share,
        reach_share_ci=of_category.reach_share_ci if isfinite(of_category.reach_share_ci[0]) else (None, None),
        follow_p=of_category.follow_p,
        use=evidence.verdict(row.category, encoded, tie),
    )
    return replace(row, image_swap=effect)


def _answers(run: RunReader, episodes: "pd.DataFrame") -> AnswerStats:
    ask = ask_of(run)
    if ask is None:
        return AnswerStats()
    text = episodes["outcome_text" if "outcome_text" in episodes else "outcome"]
    bias = episodes["letter_bias"].astype(float).mean()
    by_clause, strict = read_by_clause(episodes, text)
    return AnswerStats(
        prompt=str(ask["prompt"]),
        picture=str(ask["picture"]),
        picture_size=str(ask["picture_size"]),
        asked_for=str(ask["object"]),
        score=run.score,
        accuracy_text=float((text == "correct").mean()),
        accuracy_logits=float((episodes["outcome_logits"] == "correct").mean()),
        accuracy_order_balanced=float((episodes["outcome_debiased"] == "correct").mean()),
        share_unparsable=float((text == "oob").mean()),
        share_by_clause=by_clause,
        accuracy_strict=strict,
        option_mass=float(episodes["option_mass"].mean()),
        letter_bias=number_or_none(float(bias)),
        share_near_tie=float(episodes["near_tie"].astype(bool).mean()),
    )


def _no_success(episodes: "pd.DataFrame", heard: bool) -> SuccessRate:
    """Return an empty rate, of a model that did not act or a run that keeps nothing to judge by."""
    reason = "" if heard else "n/a: the run keeps no trajectories, which this outcome rule needs"
    items, groups = int(episodes["item_id"].nunique()), np.unique(units_of(episodes)).size
    return SuccessRate(n_episodes=len(episodes), n_items=items, n_groups=groups, reason=reason)


# -- the mean over categories --------------------------------------------------------------------------------

_PARTS = ("success", "rules", "answers", "backbone", "action", "controls", "image_swap")


def mean_row(drawn: Sequence[RowWithEstimates], averaged: Sequence[str]) -> RetentionRow:
    """The category average of rows of one run and view; retention is the ratio of the mean scores.

    averaged: fields that are averaged over the categories that have them, as `part.field`; the columns declare
    them, see `probe_kit.retention.columns.columns`. Intervals: of independent categories, see
    `mean_interval` and `Scores.mean`.
    """
    rows = [part.row for part in drawn]
    of_streams = [part.streams for part in drawn if part.streams is not None]
    # None where categories are of different streams
    probed = of_streams if len({streams.names for streams in of_streams}) == 1 else []
    first = rows[0]
    means: dict[str, dict[str, Any]] = {part: {} for part in _PARTS}
    for path in averaged:
        part, _, name = path.partition(".")
        means[part][name] = _mean(rows, path)
    return RetentionRow(
        category=MEAN,
        view=first.view,
        group=first.group,
        categories=tuple(row.category for row in rows),
        left_out=_left_out(rows),
        run=first.run,
        success=_success(rows, drawn, means["success"]),
        rules=_rules(rows, drawn, means["rules"]),
        answers=replace(first.answers, **means["answers"]),
        backbone=BackbonePart(ci=_accuracy_limits(probed, BACKBONE), **means["backbone"]),
        action=ActionPart(ci=_accuracy_limits(probed, ACTION), **means["action"]),
        retention=_retention(rows, probed),
        controls=ControlScores(
            baselines=_mean_by_key([row.controls.baselines for row in rows]),
            missing=_mean_by_key([row.controls.missing for row in rows]),
            leaks=tuple(dict.fromkeys(name for row in rows for name in row.controls.leaks)),
            untrained=first.controls.untrained,
            **means["controls"],
        ),
        image_swap=SwapEffect(**means["image_swap"]),
    )


def _accuracy_limits(probed: Sequence[StreamScores], name: str) -> Limits | None:
    if not probed or name not in probed[0].names:
        return None
    accuracies = [Rate(streams.accuracy(name), streams.interval(name)) for streams in probed]
    return limits(Rate.mean(accuracies).interval)


def _success(
    rows: Sequence[RetentionRow], drawn: Sequence[RowWithEstimates], means: dict[str, Any]
) -> SuccessRate:
    rates = [row.success.sr for row in rows if row.success.sr is not None]
    return SuccessRate(
        n_episodes=sum(row.success.n_episodes for row in rows),
        n_items=sum(row.success.n_items for row in rows),
        ci=_rate_limits(drawn, "sr"),
        normalised_score=normalised_score(rates) if len(rates) == len(rows) else None,
        **means,
    )


def _rules(
    rows: Sequence[RetentionRow], drawn: Sequence[RowWithEstimates], means: dict[str, Any]
) -> OutcomeRuleScores:
    rules = [row.rules for row in rows]
    sides = {of_category.idle_side for of_category in rules}
    return OutcomeRuleScores(
        rule=rules[0].rule,
        rule_words=rules[0].rule_words,
        last_steps=rules[0].last_steps,
        n_answered=_sum([of_category.n_answered for of_category in rules]),
        n_grasped=_sum([of_category.n_grasped for of_category in rules]),
        sr_answered_ci=_rate_limits(drawn, "sr_answered"),
        sr_grasped_ci=_rate_limits(drawn, "sr_grasped"),
        idle_side=sides.pop() if len(sides) == 1 else "both",
        sr_by_rule=_mean_by_key([of_category.sr_by_rule for of_category in rules]),
        sr_by_epsilon=_mean_by_key([of_category.sr_by_epsilon for of_category in rules]),
        behaviour=_mean_by_key([of_category.behaviour for of_category in rules]),
        **means,
    )


def _left_out(rows: Sequence[RetentionRow]) -> tuple[str, ...]:
    """Probed categories in which retention is not defined."""
    return tuple(row.category for row in rows if row.view is not None and not row.retention.defined)


def _retention(rows: Sequence[RetentionRow], probed: Sequence[StreamScores]) -> RetentionPart:
    counted, missing = [row for row in rows if row.retention.defined], _left_out(rows)
    if not probed or len(probed[0].names) < 2:
        return RetentionPart(note=rows[0].retention.note)
    ratio = retention(Scores.mean([streams.scores for streams in probed]))
    note = f"published ratios without {', '.join(missing)}" if counted and missing else ""
    return RetentionPart(
        value=ratio.value,
        ci=limits(ratio.interval),
        published=_mean(counted, "retention.published"),
        defined=bool(counted),
        note=note if counted else rows[0].retention.note,
    )


def _rate_limits(drawn: Sequence[RowWithEstimates], name: str) -> Limits | None:
    shares = [part.rates[name] for part in drawn if name in part.rates]
    if not shares:
        return None
    return limits(Rate.mean([Rate(share.value, share.interval()) for share in shares]).interval)


def _mean(rows: Sequence[RetentionRow], path: str) -> Any:
    """Average of a field, as `part.field`, over the rows that have it; None if none has."""
    read = attrgetter(path)
    values = [value for row in rows if (value := read(row)) is not None]
    return fmean(values) if values else None


def _sum(values: Sequence[int | None]) -> int | None:
    numbers = [value for value in values if value is not None]
    return sum(numbers) if numbers else None


def _mean_by_key(columns: Sequence[dict[str, float]]) -> dict[str, float]:
    """Average per key, for the keys that all have."""
    return {key: fmean(column[key] for column in columns) for key in columns[0] if all(key in c for c in columns)}
