"""The rows of one run, with the estimates that averages and differences are made of."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isnan
from typing import TYPE_CHECKING, Any

from probe_kit.env.scoring.rules import DEFAULT_RULE
from probe_kit.errors import UnknownSiteError
from probe_kit.hooks.contract.sites import first_of
from probe_kit.intervene.kinds.image_swap import stored_image_swaps
from probe_kit.intervene.results.evidence import StoredEvidence, stored_other_readouts, stored_places, stored_ties
from probe_kit.retention.behaviour.success_rate import (
    SuccessRate,
    capture_only,
    sensitivity,
    success_rate,
    success_share,
)
from probe_kit.retention.behaviour.vlm_answers import ask_of, read_by_clause
from probe_kit.retention.estimators.retention import (
    Iterations,
    Peak,
    best_site,
    curve_scores,
    estimate_retention,
    stream_peaks,
)
from probe_kit.retention.estimators.stream_scores import ACTION, BACKBONE, RowEstimates, StreamScores, limits
from probe_kit.retention.rows.interventions import add_image_swap
from probe_kit.retention.rows.outcome_rules import OutcomeRuleScores, RunUnderRule
from probe_kit.retention.rows.parts import (
    ActionPart,
    AnswerStats,
    BackbonePart,
    ControlScores,
    RetentionPart,
    RunInfo,
)
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.statistics.estimates.verdict import ABSENT_BELOW, Verdict, verdict
from probe_kit.train.data.run_reader import RunReader
from probe_kit.train.results.control_scores import Controls, Exceeds, UntrainedScore, has_signal
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class RowWithEstimates:
    """A row and the estimates behind its numbers. outcomes: the episodes of its success rate, if it has one."""

    row: RetentionRow
    estimates: RowEstimates
    outcomes: "pd.DataFrame | None" = None


@dataclass(frozen=True)
class RowSettings:
    """The settings of a table.

    epsilons: zone radii in metres for `sr_by_epsilon`, which belong to the rule `disc`. rule, last_steps: see
    `probe_kit.env.scoring.rules.judge`. absent_below: accuracy below which a stream's best site counts as absent.
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
    effects = stored_image_swaps(run)
    evidence = StoredEvidence(run)
    places = stored_places(evidence) if effects else {}
    readouts = stored_other_readouts(run, effects)
    ties = {view: stored_ties(evidence, results, view) if effects else {} for view in views}
    drawn = [
        _row(judged, results, settings, group, str(category), episodes, view)
        for category, episodes in judged.run.episodes.groupby("category", sort=False)
        if settings.categories is None or category in settings.categories
        for view in views
    ]
    return [
        replace(
            row,
            row=add_image_swap(
                row.row,
                effects,
                places,
                ties[row.row.view].get(row.row.category, ""),
                readouts.get(row.row.category),
            ),
        )
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
    estimates = RowEstimates()
    if scored:
        radii = settings.epsilons if settings.rule == DEFAULT_RULE else ()
        by_radius = {f"{radius:g}": rate for radius, rate in sensitivity(episodes, radii).items()}
        rules = replace(judged.part(episodes), sr_by_epsilon=by_radius)
        estimates = RowEstimates({"sr": success_share(episodes, run.seed_text), **judged.shares(episodes)})
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
        row, streams = _with_probes(row, run, results, settings)
        estimates = replace(estimates, streams=streams)
    return RowWithEstimates(row, estimates, episodes if scored else None)


def _with_probes(
    row: RetentionRow, run: RunReader, results: ProbeResults, settings: RowSettings
) -> tuple[RetentionRow, StreamScores | None]:
    """The row with the parts of its category's probes, and their scores."""
    curve = None if row.view is None else results.curves.get((row.category, row.view))
    if row.view is None or curve is None:
        note = f"n/a (probes {results.key} are of {', '.join(results.settings.categories)})"
        return replace(row, retention=RetentionPart(note=note)), None
    streams = curve_scores(curve, settings.iterations, run.seed_text)
    peaks = stream_peaks(curve, settings.iterations)
    exceeds = {
        name: results.controls.exceeds(row.category, row.view, str(peak.site), peak.p_fwe)
        for name, peak in peaks.items()
    }
    remedy = results.remedy(row.category, row.view)
    probed = _ProbedCategory(
        results.controls, row.category, row.view, curve, peaks, exceeds, streams, settings, remedy
    )
    row = replace(
        row,
        backbone=probed.backbone(),
        action=probed.action(),
        retention=probed.retention(),
        controls=probed.controls_of(row.success),
    )
    return row, streams


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
        letter_bias=_number(float(bias)),
        share_near_tie=float(episodes["near_tie"].astype(bool).mean()),
    )


def _no_success(episodes: "pd.DataFrame", heard: bool) -> SuccessRate:
    """Return an empty rate, of a model that did not act or a run that keeps nothing to judge by."""
    reason = "" if heard else "n/a: the run keeps no trajectories, which this outcome rule needs"
    return SuccessRate(n_episodes=len(episodes), n_items=int(episodes["item_id"].nunique()), reason=reason)


@dataclass(frozen=True)
class _ProbedCategory:
    """The probes of one category in one view.

    By stream, `backbone` and `action`: the best sites, and what these are better than. streams: the scores.
    """

    controls_run: Controls
    category: str
    view: str
    curve: ProbeCurve
    peaks: dict[str, Peak]
    exceeds: dict[str, Exceeds]
    streams: StreamScores | None
    settings: RowSettings
    remedy: str

    def backbone(self) -> BackbonePart:
        """Return the part of the backbone's best site."""
        peak = self.peaks.get(BACKBONE)
        return BackbonePart() if peak is None else BackbonePart(**self._part(BACKBONE, peak))

    def action(self) -> ActionPart:
        """Return the part of the best site where the action is made."""
        peak = self.peaks.get(ACTION)
        if peak is None:
            return ActionPart()
        first = self._first_iteration(peak)
        return ActionPart(
            iteration=peak.site.iteration,
            first_peak=None if first is None else first.accuracy,
            first_layer=None if first is None else first.site.layer,
            **self._part(ACTION, peak),
        )

    def _part(self, name: str, peak: Peak) -> dict[str, Any]:
        untrained, scored = self._untrained(peak.site.stream), self.streams
        exceeds = self.exceeds[name]
        most = None if scored is None else scored.at_most[name]
        return {
            "score": None if scored is None else scored.accuracy(name),
            "ci": None if scored is None else limits(scored.interval(name)),
            "peak": peak.accuracy if scored is None else scored.peak(name),
            "at_most": most,
            "verdict": None if scored is None else self._verdict(name, exceeds, scored),
            "site": str(peak.site),
            "layer": peak.site.layer,
            "depth": self.curve.depth(peak.site),
            "ties": peak.ties,
            "p_fwe": _number(peak.p_fwe),
            "exceeds": exceeds,
            "selectivity": self._selectivity(peak),
            "minus_untrained": None if untrained is None else untrained.difference,
            "minus_untrained_ci": None if untrained is None else untrained.ci,
            "remedy": self.remedy,
        }

    def _verdict(self, name: str, exceeds: Exceeds, scored: StreamScores) -> Verdict:
        bound = self.settings.absent_below
        return verdict(has_signal(exceeds), scored.at_most[name], scored.findable[name], bound)

    def retention(self) -> RetentionPart:
        """Return the retention of both streams."""
        if len(self.peaks) < 2:
            return RetentionPart(note="n/a (one stream only)")
        backbone = self.exceeds[BACKBONE]
        estimate = estimate_retention(self.peaks, self.streams, backbone, self.settings.absent_below)
        return RetentionPart(
            value=_number(estimate.value),
            ci=limits(estimate.interval),
            published=_number(estimate.published),
            defined=estimate.defined,
            note=estimate.note,
        )

    def controls_of(self, success: SuccessRate) -> ControlScores:
        """Return the scores that the best sites are compared with."""
        baselines = self.controls_run.of_category(self.category)
        untrained = [self._untrained(peak.site.stream) for peak in self.peaks.values()]
        score = None if self.streams is None or BACKBONE not in self.peaks else self.streams.accuracy(BACKBONE)
        return ControlScores(
            n_groups=self.curve.n_groups,
            missing=missing_episodes(self.curve),
            probe_minus_sr=None if score is None or success.sr is None else score - success.sr,
            baselines={name: score.score for name, score in baselines.items()},
            leaks=tuple(name for name, score in baselines.items() if score.above_chance),
            untrained=next((peak_score.untrained for peak_score in untrained if peak_score is not None), None),
        )

    def _untrained(self, stream: str) -> UntrainedScore | None:
        return self.controls_run.untrained_peak(self.category, self.view, stream)

    def _selectivity(self, peak: Peak) -> float | None:
        return _number(peak.accuracy - float(self.curve.control_accuracy[self.curve.sites.index(peak.site)]))

    def _first_iteration(self, peak: Peak) -> Peak | None:
        """The best layer where the stream has seen nothing of the action yet; None for one that runs once."""
        iterations = [site.iteration for site in self.curve.sites if site.stream == peak.site.stream]
        steps = [step for step in iterations if step is not None]
        return best_site(self.curve, peak.site.stream, min(steps)) if steps else None


def missing_episodes(curve: ProbeCurve) -> dict[str, float]:
    """Return by side the share of items that lack their episode of that side."""
    items = len(set(curve.items.tolist()))
    sides = {"left": curve.labels, "right": ~curve.labels}
    return {side: 1 - len(set(curve.items[is_side].tolist())) / items for side, is_side in sides.items()}


def _number(value: float) -> float | None:
    return None if isnan(value) else value
