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
from probe_kit.retention.rows.interventions import add_image_swap
from probe_kit.retention.rows.outcome_rules import OutcomeRuleScores, RunUnderRule
from probe_kit.retention.rows.parts import (
    ActionPeak,
    AnswerStats,
    BackbonePeak,
    ControlScores,
    RetentionScores,
    RunInfo,
)
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.statistics.bootstrap import units_seed
from probe_kit.statistics.fieller import Interval
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.results.control_scores import Controls, UntrainedScore
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class RowWithDraws:
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
) -> list[RowWithDraws]:
    """One row per category and view of `run`, in the order of its episodes; without `results`, success rates only.

    Raises UnknownSiteError for a view that was not probed.
    """
    shown: Sequence[str | None] = (None,) if results is None else settings.views or results.settings.views
    if results is not None and (unknown := set(settings.views or ()) - set(results.settings.views)):
        probed = ", ".join(results.settings.views)
        raise UnknownSiteError(f"{run.location} has probes of {probed}, not of {', '.join(sorted(unknown))}")
    judged, found = RunUnderRule.of(run, settings.rule, settings.last_steps), stored_image_swaps(run)
    located, carried = (stored_localised_sites(run), stored_carrying_directions(run)) if found else ({}, {})
    drawn = [
        _row(judged, results, settings, group, str(category), episodes, view)
        for category, episodes in judged.run.episodes.groupby("category", sort=False)
        for view in shown
    ]
    return [replace(one, row=add_image_swap(one.row, found, located, carried)) for one in drawn]


def _row(
    judged: RunUnderRule,
    results: ProbeResults | None,
    settings: RowSettings,
    group: str | None,
    category: str,
    episodes: "pd.DataFrame",
    view: str | None,
) -> RowWithDraws:
    run, heard = judged.run, capture_only(episodes)
    scored = judged.scored and not heard
    success = _success(run, episodes) if scored else _no_success(episodes, heard)
    rules = OutcomeRuleScores(rule=judged.rule, rule_words=judged.words)
    estimates: dict[str, Estimate] = {}
    if scored:
        radii = settings.epsilons if settings.rule == DEFAULT_RULE else ()
        by_radius = {f"{radius:g}": rate for radius, rate in sensitivity(episodes, radii).items()}
        rules = replace(judged.part(episodes), sr_by_epsilon=by_radius)
        estimates = {"sr": sr_estimate(episodes, run.suite), **judged.estimates(episodes)}
    row = RetentionRow(
        category=category,
        view=view,
        group=group,
        run=_run_info(run, results, heard),
        success=success,
        rules=rules,
        answers=_answers(run, episodes),
    )
    if results is not None and view is not None:
        row, more = _with_probes(row, run, results, settings)
        estimates |= more
    return RowWithDraws(row, estimates, episodes if scored else None)


def _with_probes(
    row: RetentionRow, run: RunReader, results: ProbeResults, settings: RowSettings
) -> tuple[RetentionRow, dict[str, Estimate]]:
    """The row with the parts of its category's probes, and their estimates."""
    curve = None if row.view is None else results.curves.get((row.category, row.view))
    if row.view is None or curve is None:
        note = f"n/a (probes {results.key} are of {', '.join(results.settings.categories)})"
        return replace(row, retention=RetentionScores(note=note)), {}
    probed = _ProbePeaks(results.controls, row.category, row.view, curve, _peaks(curve, settings.iterations))
    retention = measure_retention(curve, settings.iterations, settings.seed, probed.beats.get("backbone"))
    estimates = probe_estimates(curve, probed.peaks, retention, run.suite)
    row = replace(
        row,
        backbone=probed.backbone(estimates),
        action=probed.action(estimates),
        retention=_retention_scores(retention),
        controls=probed.controls_of(row.success),
    )
    return row, dict(estimates)


def _run_info(run: RunReader, results: ProbeResults | None, heard: bool) -> RunInfo:
    return RunInfo(
        location=str(run.location),
        model=run.model,
        label=run.label,
        random_weights=run.random_weights,
        weights_sha256=run.weights_sha256,
        suite=run.suite,
        mode="acts" if ask_of(run) is None else "answers",
        action_stream=first_of("action", run.streams.values()),
        settings=run.settings_sha256,
        probes=None if results is None else results.key,
        call=None if results is None else results.settings.call,
        capture_only=heard,
    )


def _answers(run: RunReader, episodes: "pd.DataFrame") -> AnswerStats:
    ask = ask_of(run)
    if ask is None:
        return AnswerStats()
    text = episodes["outcome_text" if "outcome_text" in episodes else "outcome"]
    bias = episodes["letter_bias"].astype(float).mean()
    return AnswerStats(
        prompt=str(ask["prompt"]),
        picture=str(ask["picture"]),
        picture_size=str(ask["picture_size"]),
        asked_for=str(ask["object"]),
        score=getattr(run, "score", "text"),
        accuracy_text=float((text == "correct").mean()),
        accuracy_logits=float((episodes["outcome_logits"] == "correct").mean()),
        accuracy_order_balanced=float((episodes["outcome_debiased"] == "correct").mean()),
        share_unparsable=float((text == "oob").mean()),
        option_mass=float(episodes["option_mass"].mean()),
        letter_bias=_number(float(bias)),
        share_near_tie=float(episodes["near_tie"].astype(bool).mean()),
    )


def _success(run: RunReader, episodes: "pd.DataFrame") -> SuccessRate:
    return success_rate(episodes, units_seed(units_of(episodes), run.suite))


def _no_success(episodes: "pd.DataFrame", heard: bool) -> SuccessRate:
    """Of a model that did not act, or whose run keeps nothing to judge by."""
    reason = "" if heard else "n/a: the run keeps no trajectories, which this outcome rule needs"
    return SuccessRate(n_episodes=len(episodes), n_items=int(episodes["item_id"].nunique()), reason=reason)


def _peaks(curve: ProbeCurve, iterations: Iterations) -> dict[str, Peak]:
    found = {"backbone": best_site(curve, "backbone")}
    if curve.action_stream is not None:
        found["action"] = best_site(curve, curve.action_stream, iterations)
    return {name: peak for name, peak in found.items() if peak is not None}


@dataclass(frozen=True)
class _ProbePeaks:
    """The probes of one category in one view, and their best sites, `backbone` and `action`."""

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
        peak, untrained = self.peaks.get("backbone"), self._untrained("backbone")
        if peak is None:
            return BackbonePeak()
        return BackbonePeak(
            accuracy=peak.accuracy,
            ci=estimates["backbone_accuracy"].ci,
            layer=peak.site.layer,
            depth=self.curve.depth(peak.site),
            p_fwe=_number(peak.p_fwe),
            selectivity=self._selectivity(peak),
            exceeds=self.beats["backbone"],
            minus_untrained=None if untrained is None else untrained.difference,
            minus_untrained_ci=None if untrained is None else untrained.ci,
            ties=peak.ties,
        )

    def action(self, estimates: Estimates) -> ActionPeak:
        """Of the best site where the action is made."""
        peak, untrained = self.peaks.get("action"), self._untrained(self.curve.action_stream)
        if peak is None:
            return ActionPeak()
        first = self._first_iteration(peak)
        return ActionPeak(
            accuracy=peak.accuracy,
            ci=estimates["action_accuracy"].ci,
            layer=peak.site.layer,
            depth=self.curve.depth(peak.site),
            iteration=peak.site.iteration,
            p_fwe=_number(peak.p_fwe),
            selectivity=self._selectivity(peak),
            exceeds=self.beats["action"],
            minus_untrained=None if untrained is None else untrained.difference,
            minus_untrained_ci=None if untrained is None else untrained.ci,
            first_accuracy=None if first is None else first.accuracy,
            first_layer=None if first is None else first.site.layer,
            ties=peak.ties,
        )

    def controls_of(self, success: SuccessRate) -> ControlScores:
        """What the best sites are compared with."""
        baselines, peak = self.controls.of_category(self.category), self.peaks.get("backbone")
        untrained = [self._untrained(stream) for stream in ("backbone", self.curve.action_stream)]
        return ControlScores(
            n_groups=self.curve.n_groups,
            chance=self.curve.chance,
            probe_minus_sr=None if peak is None or success.sr is None else peak.accuracy - success.sr,
            baselines={name: score.accuracy for name, score in baselines.items()},
            leaks=tuple(name for name, score in baselines.items() if score.above_chance),
            untrained=next((untrained.untrained for untrained in untrained if untrained is not None), None),
        )

    def _untrained(self, stream: str | None) -> UntrainedScore | None:
        return None if stream is None else self.controls.untrained_peak(self.category, self.view, stream)

    def _selectivity(self, peak: Peak) -> float | None:
        return _number(peak.accuracy - float(self.curve.control_accuracy[self.curve.sites.index(peak.site)]))

    def _first_iteration(self, peak: Peak) -> Peak | None:
        """The best layer where the stream has seen nothing of the action yet; None for one that runs once."""
        own = [site.iteration for site in self.curve.sites if site.stream == peak.site.stream]
        steps = [step for step in own if step is not None]
        return best_site(self.curve, peak.site.stream, min(steps)) if steps else None


def _retention_scores(retention: Retention | None) -> RetentionScores:
    if retention is None:
        return RetentionScores(note="n/a (one stream only)")
    return RetentionScores(
        published=_number(retention.plain),
        defined=retention.defined,
        note=retention.note,
        debiased=_number(retention.debiased),
        ci=_limits(retention.interval),
        bounded=_number(retention.bounded),
        bounded_ci=_limits(retention.bounded_interval),
        area=_number(retention.area),
        area_ci=_limits(retention.area_interval),
    )


def _limits(interval: Interval) -> Limits:
    return (interval.low, interval.high) if interval.bounded else UNBOUNDED


def _number(value: float) -> float | None:
    return None if isnan(value) else value
