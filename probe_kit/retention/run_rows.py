"""The rows of one run, with the estimates that averages and differences are made of."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isnan
from typing import TYPE_CHECKING, Any

from probe_kit.errors import UnknownSiteError
from probe_kit.hooks.sites import first_of
from probe_kit.retention.estimates import UNBOUNDED, Estimates, Limits, probe_estimates, sr_estimate
from probe_kit.retention.measure import Iterations, Peak, Retention, best_site, measure_retention
from probe_kit.retention.rows import RetentionRow
from probe_kit.retention.success import SuccessRate, sensitivity, success_rate, units_of
from probe_kit.statistics.bootstrap import units_seed
from probe_kit.statistics.fieller import Interval
from probe_kit.train.controls import Controls
from probe_kit.train.curve import Curve
from probe_kit.train.reader import RunReader
from probe_kit.train.results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Drawn:
    """A row and the estimates behind its numbers."""

    row: RetentionRow
    estimates: Estimates


@dataclass(frozen=True)
class RowSettings:
    """What a table is asked to show. epsilons: zone radii in metres for `sr_by_epsilon`. seed: of the splits."""

    views: Sequence[str] | None
    iterations: Iterations
    epsilons: Sequence[float]
    seed: int


def run_rows(
    run: RunReader, results: ProbeResults | None, settings: RowSettings, group: str | None = None
) -> list[Drawn]:
    """One row per category and view of `run`, in the order of its episodes; without `results`, success rates only.

    Raises UnknownSiteError for a view that was not probed.
    """
    shown: Sequence[str | None] = (None,) if results is None else settings.views or results.settings.views
    if results is not None and (unknown := set(settings.views or ()) - set(results.settings.views)):
        probed = ", ".join(results.settings.views)
        raise UnknownSiteError(f"{run.location} has probes of {probed}, not of {', '.join(sorted(unknown))}")
    return [
        _row(run, results, settings, group, str(category), episodes, view)
        for category, episodes in run.episodes.groupby("category", sort=False)
        for view in shown
    ]


def _row(
    run: RunReader,
    results: ProbeResults | None,
    settings: RowSettings,
    group: str | None,
    category: str,
    episodes: "pd.DataFrame",
    view: str | None,
) -> Drawn:
    success = success_rate(episodes, units_seed(units_of(episodes), run.suite))
    values = _identity(run, results) | _behaviour(success, sensitivity(episodes, settings.epsilons))
    estimates = {"sr": sr_estimate(episodes, run.suite)}
    curve = None if results is None or view is None else results.curves.get((category, view))
    if results is not None and view is not None and curve is not None:
        peaks = _peaks(curve, settings.iterations)
        beats = {
            name: results.controls.beats(category, view, str(peak.site), peak.p_fwe)
            for name, peak in peaks.items()
        }
        retention = measure_retention(curve, settings.iterations, settings.seed, beats.get("prefix"))
        estimates |= probe_estimates(curve, peaks, retention, run.suite)
        values |= _probes(curve, peaks, success, estimates) | _retention(retention)
        values |= _controls(results.controls, category, view, curve.action_stream)
        values |= {f"{name}_beats": found for name, found in beats.items()}
    return Drawn(RetentionRow(**values, category=category, view=view, group=group), estimates)


def _identity(run: RunReader, results: ProbeResults | None) -> dict[str, Any]:
    return {
        "run": str(run.location),
        "model": run.model,
        "label": run.label,
        "random_weights": run.random_weights,
        "weights_sha256": run.weights_sha256,
        "suite": run.suite,
        "action_stream": first_of("action", run.streams.values()),
        "run_settings": run.settings_sha256,
        "probe_settings": None if results is None else results.key,
        "call": None if results is None else results.settings.call,
    }


def _behaviour(success: SuccessRate, by_epsilon: dict[float, float]) -> dict[str, Any]:
    return {
        "n_episodes": success.n_episodes,
        "n_items": success.n_items,
        "sr": success.sr,
        "delta": success.delta,
        "delta_items": success.delta_items,
        "delta_regime": success.delta_regime,
        "sr_ci": success.ci,
        "sr_original": success.sr_original,
        "sr_swapped": success.sr_swapped,
        "sr_left": success.sr_left,
        "sr_right": success.sr_right,
        "p_wrong": success.p_wrong,
        "p_oob": success.p_oob,
        "p_never_moved": success.p_never_moved,
        "p_flagged": success.p_flagged,
        "regime": str(success.regime),
        "regime_reason": success.reason,
        "side_preference": success.side_preference,
        "items_both_right": success.paired.both,
        "items_one_right": success.paired.one,
        "items_none_right": success.paired.none,
        "paired_p": success.paired.p,
        "sr_by_epsilon": {f"{radius:g}": rate for radius, rate in by_epsilon.items()},
    }


def _peaks(curve: Curve, iterations: Iterations) -> dict[str, Peak]:
    found = {"prefix": best_site(curve, "backbone")}
    if curve.action_stream is not None:
        found["action"] = best_site(curve, curve.action_stream, iterations)
    return {name: peak for name, peak in found.items() if peak is not None}


def _probes(curve: Curve, peaks: dict[str, Peak], success: SuccessRate, estimates: Estimates) -> dict[str, Any]:
    found: dict[str, Any] = {"n_groups": curve.n_groups, "chance": curve.chance}
    for name, peak in peaks.items():
        control = float(curve.control_accuracy[curve.sites.index(peak.site)])
        found |= {
            f"{name}_accuracy": peak.accuracy,
            f"{name}_ci": estimates[f"{name}_accuracy"].ci,
            f"{name}_layer": peak.site.layer,
            f"{name}_depth": curve.depth(peak.site),
            f"{name}_p_fwe": _number(peak.p_fwe),
            f"{name}_selectivity": _number(peak.accuracy - control),
        }
    if "prefix" in peaks:
        found["gap"] = peaks["prefix"].accuracy - success.sr
    if "action" in peaks:
        found["action_iteration"] = peaks["action"].site.iteration
        found |= _first_iteration(curve, peaks["action"])
    return found


def _first_iteration(curve: Curve, peak: Peak) -> dict[str, Any]:
    """The best layer where the stream has seen nothing of the action yet; nothing for a stream that runs once."""
    if peak.site.iteration is None:
        return {}
    steps = [
        site.iteration for site in curve.sites if site.stream == peak.site.stream and site.iteration is not None
    ]
    first = best_site(curve, peak.site.stream, min(steps))
    return (
        {} if first is None else {"action_first_accuracy": first.accuracy, "action_first_layer": first.site.layer}
    )


def _retention(retention: Retention | None) -> dict[str, Any]:
    if retention is None:
        return {"retention_note": "n/a (one stream only)"}
    return {
        "retention": _number(retention.plain),
        "retention_defined": retention.defined,
        "retention_note": retention.note,
        "retention_debiased": _number(retention.debiased),
        "retention_ci": _limits(retention.interval),
        "retention_bounded": _number(retention.bounded),
        "retention_bounded_ci": _limits(retention.bounded_interval),
        "retention_area": _number(retention.area),
        "retention_area_ci": _limits(retention.area_interval),
    }


def _controls(controls: Controls, category: str, view: str, action_stream: str | None) -> dict[str, Any]:
    baselines = controls.of_category(category)
    found: dict[str, Any] = {
        "baselines": {name: score.accuracy for name, score in baselines.items()},
        "leaks": tuple(name for name, score in baselines.items() if score.above_chance),
    }
    for name, stream in (("prefix", "backbone"), ("action", action_stream)):
        if stream is not None and (score := controls.twin_peak(category, view, stream)) is not None:
            found |= {"twin": score.twin, f"{name}_twin": score.difference, f"{name}_twin_ci": score.ci}
    return found


def _limits(interval: Interval) -> Limits:
    return (interval.low, interval.high) if interval.bounded else UNBOUNDED


def _number(value: float) -> float | None:
    return None if isnan(value) else value
