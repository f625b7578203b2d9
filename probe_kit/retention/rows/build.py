"""The rows of one run, with the estimates that averages and differences are made of."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isnan
from typing import TYPE_CHECKING

from probe_kit.env.scoring.rules import DEFAULT_RULE
from probe_kit.errors import UnknownSiteError
from probe_kit.hooks.contract.sites import first_of
from probe_kit.intervene.kinds.image_swap.effects import stored_image_swaps
from probe_kit.intervene.results.site_maps import stored_carrying_directions, stored_localised_sites
from probe_kit.retention.behaviour.success_rate import (
    SuccessRate,
    capture_only,
    sensitivity,
    success_rate,
    units_of,
)
from probe_kit.retention.behaviour.vlm_answers import ask_of
from probe_kit.retention.estimators.bootstrap_draws import (
    UNBOUNDED,
    Estimate,
    Estimates,
    Limits,
    probe_estimates,
    sr_estimate,
)
from probe_kit.retention.estimators.retention import Iterations, Peak, Retention, best_site, measure_retention
from probe_kit.retention.rows.interventions import with_following
from probe_kit.retention.rows.outcome_rules import Judged, Ruled
from probe_kit.retention.rows.parts import ActionPeak, Asked, BackbonePeak, Background, Behaviour, Kept, Source
from probe_kit.retention.rows.row import Part, RetentionRow
from probe_kit.statistics.bootstrap import units_seed
from probe_kit.statistics.fieller import Interval
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.results.control_scores import Controls, TwinScore
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Drawn:
    """A row and the estimates behind its numbers. outcomes: the episodes of its success rate, if it has one."""

    row: RetentionRow
    estimates: Estimates
    outcomes: "pd.DataFrame | None" = None


@dataclass(frozen=True)
class RowSettings:
    """What a table is asked to show.

    epsilons: zone radii in metres for `sr_by_epsilon`, which belong to the rule `disc`. seed: of the splits.
    rule, last_steps: see `probe_kit.env.scoring.rules.judge`.
    """

    views: Sequence[str] | None
    iterations: Iterations
    epsilons: Sequence[float]
    seed: int
    rule: str = DEFAULT_RULE
    last_steps: int = 1


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
    judged, found = Judged.of(run, settings.rule, settings.last_steps), stored_image_swaps(run)
    located, carried = (stored_localised_sites(run), stored_carrying_directions(run)) if found else ({}, {})
    drawn = [
        _row(judged, results, settings, group, str(category), episodes, view)
        for category, episodes in judged.run.episodes.groupby("category", sort=False)
        for view in shown
    ]
    return [replace(one, row=with_following(one.row, found, located, carried)) for one in drawn]


def _row(
    judged: Judged,
    results: ProbeResults | None,
    settings: RowSettings,
    group: str | None,
    category: str,
    episodes: "pd.DataFrame",
    view: str | None,
) -> Drawn:
    run, heard = judged.run, capture_only(episodes)
    parts: list[Part] = [_source(run, results, heard), _asked(run, episodes)]
    estimates: dict[str, Estimate] = {}
    success = None
    if judged.scored and not heard:
        success = success_rate(episodes, units_seed(units_of(episodes), run.suite))
        radii = settings.epsilons if settings.rule == DEFAULT_RULE else ()
        parts += [judged.part(episodes), _behaviour(success, sensitivity(episodes, radii))]
        estimates = {"sr": sr_estimate(episodes, run.suite), **judged.estimates(episodes)}
    else:
        parts += [Ruled(rule=judged.rule, rule_words=judged.words), _unmoved(episodes, heard)]
    curve = None if results is None or view is None else results.curves.get((category, view))
    if results is not None and view is not None and curve is not None:
        probed = _Probed(results.controls, category, view, curve, _peaks(curve, settings.iterations))
        retention = measure_retention(curve, settings.iterations, settings.seed, probed.beats.get("prefix"))
        estimates |= probe_estimates(curve, probed.peaks, retention, run.suite)
        parts += [
            probed.backbone(estimates),
            probed.action(estimates),
            _kept(retention),
            probed.background(success),
        ]
    elif results is not None:
        parts.append(
            Kept(retention_note=f"n/a (probes {results.key} are of {', '.join(results.settings.categories)})")
        )
    return Drawn(RetentionRow.of(category, view, group, *parts), estimates, None if success is None else episodes)


def _source(run: RunReader, results: ProbeResults | None, heard: bool) -> Source:
    return Source(
        run=str(run.location),
        model=run.model,
        label=run.label,
        random_weights=run.random_weights,
        weights_sha256=run.weights_sha256,
        suite=run.suite,
        action_stream=first_of("action", run.streams.values()),
        run_settings=run.settings_sha256,
        probe_settings=None if results is None else results.key,
        call=None if results is None else results.settings.call,
        capture_only=heard,
    )


def _asked(run: RunReader, episodes: "pd.DataFrame") -> Asked:
    ask = ask_of(run)
    if ask is None:
        return Asked()
    text = episodes["outcome_text" if "outcome_text" in episodes else "outcome"]
    bias = episodes["letter_bias"].astype(float).mean()
    return Asked(
        kind="asks",
        prompt=str(ask["prompt"]),
        picture=str(ask["picture"]),
        picture_size=str(ask["picture_size"]),
        asked_for=str(ask["object"]),
        score=getattr(run, "score", "text"),
        accuracy_text=float((text == "correct").mean()),
        accuracy_logits=float((episodes["outcome_logits"] == "correct").mean()),
        accuracy_debiased=float((episodes["outcome_debiased"] == "correct").mean()),
        p_unreadable=float((text == "oob").mean()),
        option_mass=float(episodes["option_mass"].mean()),
        letter_bias=_number(float(bias)),
        p_near_tie=float(episodes["near_tie"].astype(bool).mean()),
    )


def _unmoved(episodes: "pd.DataFrame", heard: bool) -> Behaviour:
    """Of a model that was listened to, or whose run keeps nothing to judge by."""
    reason = None if heard else "n/a: the run keeps no trajectories, which this outcome rule needs"
    return Behaviour(
        n_episodes=len(episodes), n_items=int(episodes["item_id"].nunique()), sr=None, regime_reason=reason
    )


def _behaviour(success: SuccessRate, by_epsilon: dict[float, float]) -> Behaviour:
    return Behaviour(
        n_episodes=success.n_episodes,
        n_items=success.n_items,
        sr=success.sr,
        delta=success.delta,
        delta_items=success.delta_items,
        delta_regime=success.delta_regime,
        sr_ci=success.ci,
        sr_original=success.sr_original,
        sr_swapped=success.sr_swapped,
        sr_left=success.sr_left,
        sr_right=success.sr_right,
        p_wrong=success.p_wrong,
        p_oob=success.p_oob,
        p_never_moved=success.p_never_moved,
        p_flagged=success.p_flagged,
        regime=str(success.regime),
        regime_reason=success.reason,
        side_preference=success.side_preference,
        items_both_right=success.paired.both,
        items_one_right=success.paired.one,
        items_none_right=success.paired.none,
        paired_p=success.paired.p,
        sr_by_epsilon={f"{radius:g}": rate for radius, rate in by_epsilon.items()},
    )


def _peaks(curve: ProbeCurve, iterations: Iterations) -> dict[str, Peak]:
    found = {"prefix": best_site(curve, "backbone")}
    if curve.action_stream is not None:
        found["action"] = best_site(curve, curve.action_stream, iterations)
    return {name: peak for name, peak in found.items() if peak is not None}


@dataclass(frozen=True)
class _Probed:
    """The probes of one category in one view, and their best sites: `prefix` and `action`, as far as there are."""

    controls: Controls
    category: str
    view: str
    curve: ProbeCurve
    peaks: dict[str, Peak]

    @property
    def beats(self) -> dict[str, dict[str, bool | None]]:
        """Per best site, which controls it is better than."""
        return {
            name: self.controls.beats(self.category, self.view, str(peak.site), peak.p_fwe)
            for name, peak in self.peaks.items()
        }

    def backbone(self, estimates: Estimates) -> BackbonePeak:
        """Of the backbone's best site."""
        peak, twin = self.peaks.get("prefix"), self._twin("backbone")
        if peak is None:
            return BackbonePeak()
        return BackbonePeak(
            prefix_accuracy=peak.accuracy,
            prefix_ci=estimates["prefix_accuracy"].ci,
            prefix_layer=peak.site.layer,
            prefix_depth=self.curve.depth(peak.site),
            prefix_p_fwe=_number(peak.p_fwe),
            prefix_selectivity=self._selectivity(peak),
            prefix_beats=self.beats["prefix"],
            prefix_twin=None if twin is None else twin.difference,
            prefix_twin_ci=None if twin is None else twin.ci,
            prefix_ties=peak.ties,
        )

    def action(self, estimates: Estimates) -> ActionPeak:
        """Of the best site where the action is made."""
        peak, twin = self.peaks.get("action"), self._twin(self.curve.action_stream)
        if peak is None:
            return ActionPeak()
        first = self._first_iteration(peak)
        return ActionPeak(
            action_accuracy=peak.accuracy,
            action_ci=estimates["action_accuracy"].ci,
            action_layer=peak.site.layer,
            action_depth=self.curve.depth(peak.site),
            action_iteration=peak.site.iteration,
            action_p_fwe=_number(peak.p_fwe),
            action_selectivity=self._selectivity(peak),
            action_beats=self.beats["action"],
            action_twin=None if twin is None else twin.difference,
            action_twin_ci=None if twin is None else twin.ci,
            action_first_accuracy=None if first is None else first.accuracy,
            action_first_layer=None if first is None else first.site.layer,
            action_ties=peak.ties,
        )

    def background(self, success: SuccessRate | None) -> Background:
        """What the best sites are held against."""
        baselines, prefix = self.controls.of_category(self.category), self.peaks.get("prefix")
        twins = [self._twin(stream) for stream in ("backbone", self.curve.action_stream)]
        return Background(
            n_groups=self.curve.n_groups,
            chance=self.curve.chance,
            gap=None if prefix is None or success is None else prefix.accuracy - success.sr,
            baselines={name: score.accuracy for name, score in baselines.items()},
            leaks=tuple(name for name, score in baselines.items() if score.above_chance),
            twin=next((twin.twin for twin in twins if twin is not None), None),
        )

    def _twin(self, stream: str | None) -> TwinScore | None:
        return None if stream is None else self.controls.twin_peak(self.category, self.view, stream)

    def _selectivity(self, peak: Peak) -> float | None:
        return _number(peak.accuracy - float(self.curve.control_accuracy[self.curve.sites.index(peak.site)]))

    def _first_iteration(self, peak: Peak) -> Peak | None:
        """The best layer where the stream has seen nothing of the action yet; None for one that runs once."""
        own = [site.iteration for site in self.curve.sites if site.stream == peak.site.stream]
        steps = [step for step in own if step is not None]
        return best_site(self.curve, peak.site.stream, min(steps)) if steps else None


def _kept(retention: Retention | None) -> Kept:
    if retention is None:
        return Kept(retention_note="n/a (one stream only)")
    return Kept(
        retention=_number(retention.plain),
        retention_defined=retention.defined,
        retention_note=retention.note,
        retention_debiased=_number(retention.debiased),
        retention_ci=_limits(retention.interval),
        retention_bounded=_number(retention.bounded),
        retention_bounded_ci=_limits(retention.bounded_interval),
        retention_area=_number(retention.area),
        retention_area_ci=_limits(retention.area_interval),
    )


def _limits(interval: Interval) -> Limits:
    return (interval.low, interval.high) if interval.bounded else UNBOUNDED


def _number(value: float) -> float | None:
    return None if isnan(value) else value
