"""The average over the categories of one run, with its intervals."""

from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from statistics import fmean
from typing import Any

from probe_kit.retention.behaviour.success_rate import SuccessRate, normalised_score
from probe_kit.retention.estimators.stream_scores import (
    ACTION,
    BACKBONE,
    Limits,
    Rate,
    RowEstimates,
    StreamScores,
    limits,
)
from probe_kit.retention.rows.build import RowWithEstimates
from probe_kit.retention.rows.outcome_rules import OutcomeRuleScores
from probe_kit.retention.rows.parts import ActionPart, BackbonePart, ControlScores, RetentionPart, SwapEffect
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.statistics.estimates.retention import retention
from probe_kit.statistics.estimates.scores import Scores


def mean_row(drawn: Sequence[RowWithEstimates], averaged: Sequence[str]) -> RetentionRow:
    """The category average of rows of one run and view; retention is the ratio of the mean scores.

    averaged: fields that are averaged over the categories that have them, as `part.field`; the columns declare
    them, see `probe_kit.retention.columns.columns`. Intervals: of independent
    categories, see `probe_kit.statistics.estimates`.
    """
    rows = [part.row for part in drawn]
    estimates = [part.estimates for part in drawn]
    probed = _probed(estimates)
    first = rows[0]
    means = _means(rows, averaged)
    return RetentionRow(
        category=MEAN,
        view=first.view,
        group=first.group,
        categories=tuple(row.category for row in rows),
        left_out=_left_out(rows),
        run=first.run,
        success=_success(rows, estimates, means["success"]),
        rules=_rules(rows, estimates, means["rules"]),
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


def _probed(estimates: Sequence[RowEstimates]) -> list[StreamScores]:
    """Scores of the probed categories; none where they are of different streams."""
    streams_of = [estimate.streams for estimate in estimates if estimate.streams is not None]
    return streams_of if len({streams.names for streams in streams_of}) == 1 else []


def _accuracy_limits(probed: Sequence[StreamScores], name: str) -> Limits | None:
    if not probed or name not in probed[0].names:
        return None
    accuracies = [Rate(streams.accuracy(name), streams.interval(name)) for streams in probed]
    return limits(Rate.mean(accuracies).interval)


_PARTS = ("success", "rules", "answers", "backbone", "action", "controls", "image_swap")


def _means(rows: Sequence[RetentionRow], averaged: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return by part the averages of its fields."""
    means: dict[str, dict[str, Any]] = {part: {} for part in _PARTS}
    for path in averaged:
        part, _, name = path.partition(".")
        means[part][name] = _mean(rows, path)
    return means


def _success(
    rows: Sequence[RetentionRow], estimates: Sequence[RowEstimates], means: dict[str, Any]
) -> SuccessRate:
    rates = [row.success.sr for row in rows if row.success.sr is not None]
    return SuccessRate(
        n_episodes=sum(row.success.n_episodes for row in rows),
        n_items=sum(row.success.n_items for row in rows),
        ci=_rate_limits(estimates, "sr"),
        normalised_score=normalised_score(rates) if len(rates) == len(rows) else None,
        **means,
    )


def _rules(
    rows: Sequence[RetentionRow], estimates: Sequence[RowEstimates], means: dict[str, Any]
) -> OutcomeRuleScores:
    rules = [row.rules for row in rows]
    sides = {of_category.idle_side for of_category in rules}
    return OutcomeRuleScores(
        rule=rules[0].rule,
        rule_words=rules[0].rule_words,
        last_steps=rules[0].last_steps,
        n_answered=_sum([of_category.n_answered for of_category in rules]),
        n_grasped=_sum([of_category.n_grasped for of_category in rules]),
        sr_answered_ci=_rate_limits(estimates, "sr_answered"),
        sr_grasped_ci=_rate_limits(estimates, "sr_grasped"),
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


def _rate_limits(estimates: Sequence[RowEstimates], name: str) -> Limits | None:
    shares = [estimate.rates[name] for estimate in estimates if name in estimate.rates]
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
