"""The average over the categories of one run, with its intervals."""

from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from statistics import fmean
from typing import Any

from probe_kit.retention.behaviour.success_rate import SuccessRate, normalised_score
from probe_kit.retention.estimators.bootstrap_draws import UNBOUNDED, Estimates, Limits, average
from probe_kit.retention.rows.build import RowWithDraws
from probe_kit.retention.rows.outcome_rules import OutcomeRuleScores
from probe_kit.retention.rows.parts import ActionPeak, BackbonePeak, ControlScores, RetentionScores, SwapEffect
from probe_kit.retention.rows.row import MEAN, RetentionRow


def mean_row(drawn: Sequence[RowWithDraws], averaged: Sequence[str]) -> RetentionRow:
    """The category average of rows of one run and view; retention over the categories where it is defined.

    averaged: fields that are averaged over the categories that have them, as `part.field`; the columns declare
    them, see `probe_kit.retention.columns.columns`. Intervals: items, or groups for probes, drawn within each
    category.
    """
    rows = [one.row for one in drawn]
    estimates = average_estimates([one.estimates for one in drawn])
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
        backbone=BackbonePeak(ci=_limits(estimates, "backbone_accuracy"), **means["backbone"]),
        action=ActionPeak(ci=_limits(estimates, "action_accuracy"), **means["action"]),
        retention=_retention(rows, estimates),
        controls=ControlScores(
            baselines=_mean_by_key([row.controls.baselines for row in rows]),
            leaks=tuple(dict.fromkeys(name for row in rows for name in row.controls.leaks)),
            untrained=first.controls.untrained,
            **means["controls"],
        ),
        image_swap=SwapEffect(**means["image_swap"]),
    )


def average_estimates(estimates: Sequence[Estimates]) -> Estimates:
    """Every quantity averaged over those that have it."""
    names = dict.fromkeys(name for found in estimates for name in found)
    return {name: average([found[name] for found in estimates if name in found]) for name in names}


_PARTS = ("success", "rules", "answers", "backbone", "action", "controls", "image_swap")


def _means(rows: Sequence[RetentionRow], averaged: Sequence[str]) -> dict[str, dict[str, Any]]:
    """By part, the averages of its fields."""
    means: dict[str, dict[str, Any]] = {part: {} for part in _PARTS}
    for path in averaged:
        part, _, name = path.partition(".")
        means[part][name] = _mean(rows, path)
    return means


def _success(rows: Sequence[RetentionRow], estimates: Estimates, means: dict[str, Any]) -> SuccessRate:
    rates = [row.success.sr for row in rows if row.success.sr is not None]
    return SuccessRate(
        n_episodes=sum(row.success.n_episodes for row in rows),
        n_items=sum(row.success.n_items for row in rows),
        ci=_limits(estimates, "sr"),
        normalised_score=normalised_score(rates) if len(rates) == len(rows) else None,
        **means,
    )


def _rules(rows: Sequence[RetentionRow], estimates: Estimates, means: dict[str, Any]) -> OutcomeRuleScores:
    found = [row.rules for row in rows]
    sides = {one.idle_side for one in found}
    return OutcomeRuleScores(
        rule=found[0].rule,
        rule_words=found[0].rule_words,
        last_steps=found[0].last_steps,
        n_answered=_sum([one.n_answered for one in found]),
        n_grasped=_sum([one.n_grasped for one in found]),
        sr_answered_ci=_limits(estimates, "sr_answered"),
        sr_grasped_ci=_limits(estimates, "sr_grasped"),
        idle_side=sides.pop() if len(sides) == 1 else "both",
        sr_by_rule=_mean_by_key([one.sr_by_rule for one in found]),
        sr_by_epsilon=_mean_by_key([one.sr_by_epsilon for one in found]),
        behaviour=_mean_by_key([one.behaviour for one in found]),
        **means,
    )


def _left_out(rows: Sequence[RetentionRow]) -> tuple[str, ...]:
    """Probed categories in which retention is not defined."""
    return tuple(row.category for row in rows if row.view is not None and not row.retention.defined)


def _retention(rows: Sequence[RetentionRow], estimates: Estimates) -> RetentionScores:
    counted = [row for row in rows if row.retention.defined]
    if not counted:
        return RetentionScores(note=rows[0].retention.note)
    left_out = _left_out(rows)
    scores: dict[str, Any] = {
        name: _mean(counted, f"retention.{name}") for name in ("published", "debiased", "bounded", "area")
    }
    for name, limits in (("debiased", "ci"), ("bounded", "bounded_ci"), ("area", "area_ci")):
        scores[limits] = _retention_limits(counted, estimates, f"retention_{name}", limits)
    note = f"without {', '.join(left_out)}" if left_out else ""
    return RetentionScores(defined=True, note=note, **scores)


def _limits(estimates: Estimates, name: str) -> Limits | None:
    found = estimates.get(name)
    return None if found is None else found.ci


def _retention_limits(
    counted: Sequence[RetentionRow], estimates: Estimates, name: str, limits: str
) -> Limits | None:
    """The category's own where there is one, and none where one category has none: a mean knows no more.

    Those of several are around their mean, as ratios are skewed.
    """
    own: list[Limits | None] = [getattr(row.retention, limits) for row in counted]
    if len(counted) == 1:
        return own[0]
    if UNBOUNDED in own:
        return UNBOUNDED
    found = estimates.get(name)
    return None if found is None else found.centred.ci


def _mean(rows: Sequence[RetentionRow], path: str) -> Any:
    """Average of a field, as `part.field`, over the rows that have it; None if none has."""
    read = attrgetter(path)
    values = [value for row in rows if (value := read(row)) is not None]
    return fmean(values) if values else None


def _sum(values: Sequence[int | None]) -> int | None:
    known = [value for value in values if value is not None]
    return sum(known) if known else None


def _mean_by_key(columns: Sequence[dict[str, float]]) -> dict[str, float]:
    """Average per key, for the keys that all have."""
    return {key: fmean(column[key] for column in columns) for key in columns[0] if all(key in c for c in columns)}
