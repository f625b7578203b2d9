"""The average over the categories of one run, with its intervals."""

from collections.abc import Sequence
from statistics import fmean
from typing import Any

from probe_kit.retention.behaviour.success_rate import normalised_score
from probe_kit.retention.estimators.bootstrap_draws import UNBOUNDED, Estimates, Limits, average
from probe_kit.retention.rows.build import RowWithDraws
from probe_kit.retention.rows.outcome_rules import mean_part
from probe_kit.retention.rows.row import MEAN, RetentionRow

_AVERAGED = (
    "sr_original", "sr_swapped", "sr_left", "sr_right", "share_wrong", "share_outside", "share_never_moved", "share_invalid_action", "chance",
    "backbone_accuracy", "action_accuracy", "gap", "backbone_selectivity", "action_selectivity", "backbone_minus_untrained",
    "action_minus_untrained", "action_first_accuracy", "accuracy_text", "accuracy_logits", "accuracy_order_balanced",
    "share_unparsable", "option_mass", "letter_bias", "share_near_tie", "follows", "against", "follows_net",
)  # fmt: skip
_OF_THE_RUN = ("kind", "prompt", "picture", "picture_size", "asked_for", "score")


def mean_row(drawn: Sequence[RowWithDraws]) -> RetentionRow:
    """The category average of rows of one run and view; retention over the categories where it is defined.

    Intervals: items, or groups for probes, drawn within each category.
    """
    rows = [one.row for one in drawn]
    estimates = average_estimates([one.estimates for one in drawn])
    first, counted = rows[0], [row for row in rows if row.retention_defined]
    left_out = tuple(row.category for row in rows if row.view is not None and not row.retention_defined)
    note = f"without {', '.join(left_out)}" if left_out else ""
    acted = all(row.sr is not None for row in rows)
    return RetentionRow(
        run=first.run,
        model=first.model,
        label=first.label,
        call=first.call,
        random_weights=first.random_weights,
        weights_sha256=first.weights_sha256,
        suite=first.suite,
        run_settings=first.run_settings,
        probe_settings=first.probe_settings,
        group=first.group,
        category=MEAN,
        **{name: getattr(first, name) for name in _OF_THE_RUN},
        view=first.view,
        action_stream=first.action_stream,
        n_episodes=sum(row.n_episodes for row in rows),
        n_items=sum(row.n_items for row in rows),
        listened=first.listened,
        normalised_score=normalised_score([row.sr for row in rows if row.sr is not None]) if acted else None,
        sr=_mean(rows, "sr"),
        **vars(mean_part(rows, {name: _limits(estimates, name) for name in ("sr_answered", "sr_grasped")})),
        sr_ci=_limits(estimates, "sr"),
        backbone_ci=_limits(estimates, "backbone_accuracy"),
        action_ci=_limits(estimates, "action_accuracy"),
        **{name: _mean(rows, name) for name in _AVERAGED},
        sr_by_epsilon=_mean_by_key([row.sr_by_epsilon for row in rows]),
        baselines=_mean_by_key([row.baselines for row in rows]),
        leaks=tuple(dict.fromkeys(name for row in rows for name in row.leaks)),
        untrained=first.untrained,
        retention=_mean(counted, "retention"),
        retention_debiased=_mean(counted, "retention_debiased"),
        retention_ci=_retention_limits(counted, estimates, "retention_debiased", "retention_ci"),
        **_other_retention(counted, estimates),
        retention_defined=bool(counted),
        retention_note=note if counted else first.retention_note,
        categories=tuple(row.category for row in rows),
        left_out=left_out,
    )


def average_estimates(estimates: Sequence[Estimates]) -> Estimates:
    """Every quantity averaged over those that have it."""
    names = dict.fromkeys(name for found in estimates for name in found)
    return {name: average([found[name] for found in estimates if name in found]) for name in names}


def _limits(estimates: Estimates, name: str) -> Limits | None:
    found = estimates.get(name)
    return None if found is None else found.ci


def _other_retention(counted: Sequence[RetentionRow], estimates: Estimates) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in ("retention_bounded", "retention_area"):
        found[name] = _mean(counted, name)
        found[f"{name}_ci"] = _retention_limits(counted, estimates, name, f"{name}_ci")
    return found


def _retention_limits(
    counted: Sequence[RetentionRow], estimates: Estimates, name: str, limits: str
) -> Limits | None:
    """The category's own where there is one, and none where one category has none: a mean knows no more.

    Those of several are around their mean, as ratios are skewed.
    """
    if len(counted) == 1:
        own: Limits | None = getattr(counted[0], limits)
        return own
    if any(getattr(row, limits) == UNBOUNDED for row in counted):
        return UNBOUNDED
    found = estimates.get(name)
    return None if found is None else found.centred.ci


def _mean(rows: Sequence[RetentionRow], name: str) -> Any:
    """Average of a column over the rows that have it; None if none has."""
    values = [value for row in rows if (value := getattr(row, name)) is not None]
    return fmean(values) if values else None


def _mean_by_key(columns: Sequence[dict[str, float]]) -> dict[str, float]:
    """Average per key, for the keys that all have."""
    return {key: fmean(column[key] for column in columns) for key in columns[0] if all(key in c for c in columns)}
