"""One row per run, category and view: behaviour, probes and retention side by side."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isnan
from statistics import fmean
from typing import Any

from probe_kit.errors import UnknownSiteError
from probe_kit.identity import derive_seed
from probe_kit.retention.measure import Iterations, Peak, best_site, measure_retention
from probe_kit.retention.success import SuccessRate, normalised_score, success_rate
from probe_kit.train.curve import Curve
from probe_kit.train.reader import RunReader
from probe_kit.train.results import ProbeResults

MEAN = "mean"
"""Category of the rows that average over categories."""


@dataclass(frozen=True)
class RetentionRow:
    """One line of the retention table; None where there is nothing to say.

    Shares and accuracies run from 0 to 1, depths from 0 to 1 of the stream. `retention` is the published ratio
    even when `retention_defined` is False, and then no category mean contains it. `retention_ci` is the 95 %
    interval of `retention_debiased`, (None, None) when the data set no limit. `gap` = prefix accuracy − SR.
    In a row of category `mean`, numbers are averages over `categories` and retention leaves out `left_out`.
    """

    run: str
    model: str
    random_weights: bool
    suite: str
    run_settings: str
    probe_settings: str | None
    category: str
    view: str | None
    n_episodes: int
    n_items: int
    sr: float
    delta: float | None = None
    delta_items: float | None = None
    sr_ci: tuple[float, float] | None = None
    sr_original: float | None = None
    sr_swapped: float | None = None
    sr_left: float | None = None
    sr_right: float | None = None
    p_wrong: float | None = None
    p_oob: float | None = None
    regime: str | None = None
    regime_reason: str | None = None
    side_preference: float | None = None
    items_both_right: int | None = None
    items_one_right: int | None = None
    items_none_right: int | None = None
    paired_p: float | None = None
    normalised_score: float | None = None
    n_groups: int | None = None
    chance: float | None = None
    prefix_accuracy: float | None = None
    prefix_layer: int | None = None
    prefix_depth: float | None = None
    prefix_p_fwe: float | None = None
    action_accuracy: float | None = None
    action_layer: int | None = None
    action_depth: float | None = None
    action_iteration: int | None = None
    action_p_fwe: float | None = None
    retention: float | None = None
    retention_defined: bool = False
    retention_note: str = "n/a (no probes)"
    retention_debiased: float | None = None
    retention_ci: tuple[float | None, float | None] | None = None
    gap: float | None = None
    categories: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


def run_rows(
    run: RunReader, results: ProbeResults | None, views: Sequence[str] | None, iterations: Iterations, seed: int
) -> list[RetentionRow]:
    """One row per category and view of `run`, in the order of its episodes; without `results`, success rates only.

    Raises UnknownSiteError for a view that was not probed.
    """
    shown: Sequence[str | None] = (None,) if results is None else views or results.settings.views
    if results is not None and (unknown := set(views or ()) - set(results.settings.views)):
        probed = ", ".join(results.settings.views)
        raise UnknownSiteError(f"{run.path} has probes of {probed}, not of {', '.join(sorted(unknown))}")
    rows = []
    for category, episodes in run.episodes.groupby("category", sort=False):
        success = success_rate(episodes, derive_seed("success", seed))
        for view in shown:
            curve = None if results is None or view is None else results.curves.get((str(category), view))
            probes = {} if curve is None else _probes(curve, success, iterations, seed)
            rows.append(
                RetentionRow(
                    **_identity(run, results),
                    category=str(category),
                    view=view,
                    **_behaviour(success),
                    **probes,
                )
            )
    return rows


def mean_row(rows: Sequence[RetentionRow]) -> RetentionRow:
    """The category average of rows of one run and view; retention over the categories where it is defined."""
    first = rows[0]
    counted = [row for row in rows if row.retention_defined]
    left_out = tuple(row.category for row in rows if row.view is not None and not row.retention_defined)
    note = f"without {', '.join(left_out)}" if left_out else ""
    return RetentionRow(
        run=first.run,
        model=first.model,
        random_weights=first.random_weights,
        suite=first.suite,
        run_settings=first.run_settings,
        probe_settings=first.probe_settings,
        category=MEAN,
        view=first.view,
        n_episodes=sum(row.n_episodes for row in rows),
        n_items=sum(row.n_items for row in rows),
        normalised_score=normalised_score([row.sr for row in rows]),
        sr=fmean(row.sr for row in rows),
        **{name: _mean(rows, name) for name in _AVERAGED},
        retention=_mean(counted, "retention"),
        retention_debiased=_mean(counted, "retention_debiased"),
        retention_defined=bool(counted),
        retention_note=note if counted else first.retention_note,
        categories=tuple(row.category for row in rows),
        left_out=left_out,
    )


_AVERAGED = (
    "sr_original", "sr_swapped", "sr_left", "sr_right", "p_wrong", "p_oob",
    "chance", "prefix_accuracy", "action_accuracy", "gap",
)  # fmt: skip


def _mean(rows: Sequence[RetentionRow], name: str) -> Any:
    """Average of a column over the rows that have it; None if none has."""
    values = [value for row in rows if (value := getattr(row, name)) is not None]
    return fmean(values) if values else None


def _identity(run: RunReader, results: ProbeResults | None) -> dict[str, Any]:
    return {
        "run": str(run.path),
        "model": run.model,
        "random_weights": run.random_weights,
        "suite": run.suite,
        "run_settings": run.settings_sha256,
        "probe_settings": None if results is None else results.key,
    }


def _behaviour(success: SuccessRate) -> dict[str, Any]:
    return {
        "n_episodes": success.n_episodes,
        "n_items": success.n_items,
        "sr": success.sr,
        "delta": success.delta,
        "delta_items": success.delta_items,
        "sr_ci": success.ci,
        "sr_original": success.sr_original,
        "sr_swapped": success.sr_swapped,
        "sr_left": success.sr_left,
        "sr_right": success.sr_right,
        "p_wrong": success.p_wrong,
        "p_oob": success.p_oob,
        "regime": str(success.regime),
        "regime_reason": success.reason,
        "side_preference": success.side_preference,
        "items_both_right": success.paired.both,
        "items_one_right": success.paired.one,
        "items_none_right": success.paired.none,
        "paired_p": success.paired.p,
    }


def _probes(curve: Curve, success: SuccessRate, iterations: Iterations, seed: int) -> dict[str, Any]:
    found: dict[str, Any] = {"n_groups": curve.n_groups, "chance": curve.chance}
    prefix, action = best_site(curve, "backbone"), best_site(curve, "expert", iterations)
    if prefix is not None:
        found |= _peak("prefix", prefix, curve) | {"gap": prefix.accuracy - success.sr}
    if action is not None:
        found |= _peak("action", action, curve) | {"action_iteration": action.site.iteration}
    retention = measure_retention(curve, iterations, seed)
    if retention is None:
        return found | {"retention_note": "n/a (one stream only)"}
    return found | {
        "retention": _number(retention.plain),
        "retention_defined": retention.defined,
        "retention_note": retention.note,
        "retention_debiased": _number(retention.debiased),
        "retention_ci": (
            (retention.interval.low, retention.interval.high) if retention.interval.bounded else (None, None)
        ),
    }


def _peak(name: str, peak: Peak, curve: Curve) -> dict[str, Any]:
    return {
        f"{name}_accuracy": peak.accuracy,
        f"{name}_layer": peak.site.layer,
        f"{name}_depth": curve.depth(peak.site),
        f"{name}_p_fwe": _number(peak.p_fwe),
    }


def _number(value: float) -> float | None:
    return None if isnan(value) else value
