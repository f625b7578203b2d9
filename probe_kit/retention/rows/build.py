"""The rows of one run and their mean, of behaviour and probes, with the estimates behind their numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite, isnan, nan
from operator import attrgetter
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit._tables.numbers import Limits
from probe_kit.env.scoring import DEFAULT_RULE
from probe_kit.errors import UnknownSiteError
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.evidence import StoredEvidence, stored_ties
from probe_kit.retention.behaviour import (
    OutcomeRuleScores,
    SuccessRate,
    TableRun,
    normalised_score,
    read_by_clause,
    sensitivity,
    success_rate,
    success_share,
    units_of,
)
from probe_kit.retention.choices import Iterations
from probe_kit.retention.estimators import (
    ACTION,
    BACKBONE,
    Peak,
    Rate,
    StreamScores,
    best_site,
    curve_scores,
    estimate_of_peaks,
    limits,
    missing_condition,
    probed_curve,
    stream_peaks,
)
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
from probe_kit.statistics.paired_tests import holm
from probe_kit.statistics.retention import Scores, retention
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.sufficiency import ABSENT_BELOW, verdict
from probe_kit.train.choices import CORRECT
from probe_kit.train.results.control_scores import has_signal
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class RowWithEstimates:
    """A row and the estimates behind its numbers.

    Attributes:
        rates: Shares of episodes by name, such as `sr`.
        streams: Cross-fitted scores, None without probes.
        outcomes: The episodes of its success rate, if it has one.
    """

    row: RetentionRow
    rates: Mapping[str, Share] = field(default_factory=dict)
    streams: StreamScores | None = None
    outcomes: "pd.DataFrame | None" = None


@dataclass(frozen=True)
class RowSettings:
    """The settings of a table.

    Attributes:
        views: Views of the probes; None for all.
        iterations: Iterations of the action's stream that take part.
        epsilons: Zone radii in metres for `sr_by_epsilon`, which belong to the rule `disc`.
        absent_below: Accuracy below which a stream's best site counts as absent.
        categories: Categories that have rows; None for all.
    """

    views: Sequence[str] | None
    iterations: Iterations
    epsilons: Sequence[float]
    absent_below: float = ABSENT_BELOW
    categories: Sequence[str] | None = None


def run_rows(table_run: TableRun, results: ProbeResults | None, settings: RowSettings) -> list[RowWithEstimates]:
    """Return one row per category and view of a run, in the order of its episodes.

    Without `results`, rows have success rates only. Probes of a target that is no side have rows without success.

    Args:
        table_run: The run with its outcomes by the table's rule.
        results: Its probes; None without any.
        settings: Views, categories and limits of the table.

    Raises:
        UnknownSiteError: For a view that was not probed.
    """
    if results is not None and not results.settings.balanced:
        return [
            RowWithEstimates(target_row(table_run, results, category, view, settings.iterations))
            for category in results.settings.categories
            for view in settings.views or results.settings.views
        ]
    views: Sequence[str | None] = (None,) if results is None else settings.views or results.settings.views
    if results is not None and (unknown := set(settings.views or ()) - set(results.settings.views)):
        probed = ", ".join(results.settings.views)
        raise UnknownSiteError(f"{table_run.location} has probes of {probed}, not of {', '.join(sorted(unknown))}")
    evidence = StoredEvidence(table_run.run)
    ties = {view: stored_ties(evidence, results, view) if evidence.swaps else {} for view in views}
    rows = [
        _row(table_run, results, settings, str(category), episodes, view)
        for category, episodes in table_run.judged.episodes.groupby("category", sort=False)
        if settings.categories is None or category in settings.categories
        for view in views
    ]
    return [
        replace(row, row=add_image_swap(row.row, evidence, ties[row.row.view].get(row.row.category, "")))
        for row in rows
    ]


def _row(
    table_run: TableRun,
    results: ProbeResults | None,
    settings: RowSettings,
    category: str,
    episodes: "pd.DataFrame",
    view: str | None,
) -> RowWithEstimates:
    run = table_run.judged
    success = success_rate(episodes) if table_run.is_judged else _no_success(table_run, episodes)
    rules = OutcomeRuleScores(rule=table_run.rule, rule_words=table_run.words)
    rates, streams = dict[str, Share](), None
    if table_run.is_judged:
        radii = settings.epsilons if table_run.rule == DEFAULT_RULE else ()
        by_radius = {f"{radius:g}": rate for radius, rate in sensitivity(episodes, radii).items()}
        rules, shares = table_run.part(episodes)
        rules = replace(rules, sr_by_epsilon=by_radius)
        rates = {"sr": success_share(episodes, run.seed_text), **shares}
    row = RetentionRow(
        category=category,
        view=view,
        target=CORRECT if results is None else results.settings.target,
        group=table_run.group,
        run=RunInfo.of(table_run, results),
        success=success,
        rules=rules,
        answers=_answers(run, episodes),
    )
    if results is not None and view is not None:
        row, streams = with_probes(row, results, settings.iterations, settings.absent_below, run.seed_text)
    return RowWithEstimates(row, rates, streams, episodes if table_run.is_judged else None)


def add_image_swap(row: RetentionRow, evidence: StoredEvidence, tie: str = "") -> RetentionRow:
    """Return the row with the effect of the image swap on its category, judged by its own probes.

    Args:
        row: A row with its probes.
        evidence: Stored interventions of the row's run.
        tie: The tie of the row's category and view, see `evidence.stored_ties`.
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
    ask = run.ask
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


def _no_success(table_run: TableRun, episodes: "pd.DataFrame") -> SuccessRate:
    """Return an empty rate, for a model that did not act or a run without trajectories to judge by."""
    captured_only = table_run.is_captured_only
    reason = "" if captured_only else "n/a: the run keeps no trajectories, which this outcome rule needs"
    items, groups = int(episodes["item_id"].nunique()), np.unique(units_of(episodes)).size
    return SuccessRate(n_episodes=len(episodes), n_items=items, n_groups=groups, reason=reason)


# -- the mean over categories --------------------------------------------------------------------------------

_PARTS = ("success", "rules", "answers", "backbone", "action", "controls", "image_swap")


def mean_row(estimated: Sequence[RowWithEstimates], averaged: Sequence[str]) -> RetentionRow:
    """Return the category average of rows of one run and view; retention is the ratio of the mean scores.

    Intervals are of independent categories, see `mean_interval` and `Scores.mean`.

    Args:
        estimated: Rows of one run and view, with their estimates.
        averaged: Fields that are averaged over the categories that have them, as `part.field`; the columns declare
            them, see `probe_kit.retention.columns.columns`.
    """
    rows = [part.row for part in estimated]
    of_streams = [part.streams for part in estimated if part.streams is not None]
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
        success=_success(rows, estimated, means["success"]),
        rules=_rules(rows, estimated, means["rules"]),
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
    rows: Sequence[RetentionRow], estimated: Sequence[RowWithEstimates], means: dict[str, Any]
) -> SuccessRate:
    rates = [row.success.sr for row in rows if row.success.sr is not None]
    return SuccessRate(
        n_episodes=sum(row.success.n_episodes for row in rows),
        n_items=sum(row.success.n_items for row in rows),
        ci=_rate_limits(estimated, "sr"),
        normalised_score=normalised_score(rates) if len(rates) == len(rows) else None,
        **means,
    )


def _rules(
    rows: Sequence[RetentionRow], estimated: Sequence[RowWithEstimates], means: dict[str, Any]
) -> OutcomeRuleScores:
    rules = [row.rules for row in rows]
    sides = {of_category.idle_side for of_category in rules}
    return OutcomeRuleScores(
        rule=rules[0].rule,
        rule_words=rules[0].rule_words,
        last_steps=rules[0].last_steps,
        n_answered=_sum([of_category.n_answered for of_category in rules]),
        n_grasped=_sum([of_category.n_grasped for of_category in rules]),
        sr_answered_ci=_rate_limits(estimated, "sr_answered"),
        sr_grasped_ci=_rate_limits(estimated, "sr_grasped"),
        idle_side=sides.pop() if len(sides) == 1 else "both",
        sr_by_rule=_mean_by_key([of_category.sr_by_rule for of_category in rules]),
        sr_by_epsilon=_mean_by_key([of_category.sr_by_epsilon for of_category in rules]),
        behaviour=_mean_by_key([of_category.behaviour for of_category in rules]),
        **means,
    )


def _left_out(rows: Sequence[RetentionRow]) -> tuple[str, ...]:
    """Return the probed categories in which retention is not defined."""
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


def _rate_limits(estimated: Sequence[RowWithEstimates], name: str) -> Limits | None:
    shares = [part.rates[name] for part in estimated if name in part.rates]
    if not shares:
        return None
    return limits(Rate.mean([Rate(share.value, share.interval()) for share in shares]).interval)


def _mean(rows: Sequence[RetentionRow], path: str) -> Any:
    """Return the average of a field, as `part.field`, over the rows that have it; None if none has."""
    read = attrgetter(path)
    values = [value for row in rows if (value := read(row)) is not None]
    return fmean(values) if values else None


def _sum(values: Sequence[int | None]) -> int | None:
    numbers = [value for value in values if value is not None]
    return sum(numbers) if numbers else None


def _mean_by_key(columns: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the average per key, for the keys that all have."""
    return {key: fmean(column[key] for column in columns) for key in columns[0] if all(key in c for c in columns)}


# -- parts that probes give -----------------------------------------------------------------------------------


def with_probes(
    row: RetentionRow,
    results: ProbeResults,
    iterations: Iterations = "all",
    absent_below: float = ABSENT_BELOW,
    seed_text: str = "",
) -> tuple[RetentionRow, StreamScores | None]:
    """Return the row with the parts of its category's probes, and their scores; None where there are none.

    Args:
        row: A row with its category and view.
        results: Probes of the row's run.
        iterations: Iterations of the action's stream that take part.
        absent_below: Accuracy below which a stream without signal counts as absent, see `verdict`.
        seed_text: Seed text of the run; scores on equal groups of one are paired.
    """
    view = row.view
    curve = None if view is None else results.curves.get((row.category, view))
    if view is None or curve is None:
        note = f"n/a (probes {results.key} are of {', '.join(results.settings.categories)})"
        return replace(row, retention=RetentionPart(note=note)), None
    streams, peaks = curve_scores(curve, iterations, seed_text), stream_peaks(curve, iterations)
    parts = {
        name: _stream_part(row, results, curve, name, peak, streams, absent_below) for name, peak in peaks.items()
    }
    row = replace(
        row,
        backbone=BackbonePart(**parts.get(BACKBONE, {})),
        action=ActionPart(**parts.get(ACTION, {}), **_iterations(curve, peaks.get(ACTION))),
    )
    exceeds = row.backbone.exceeds if BACKBONE in peaks else {}
    retained = estimate_of_peaks(results, row.category, view, peaks, exceeds, streams, absent_below)
    estimate = RetentionPart(
        value=number_or_none(retained.value),
        ci=limits(retained.interval) if len(peaks) == 2 else None,
        published=number_or_none(retained.published),
        defined=retained.defined,
        note=retained.note,
        reason=retained.reason,
    )
    return replace(row, retention=estimate, controls=_controls(row, results, curve, peaks)), streams


def _stream_part(
    row: RetentionRow,
    results: ProbeResults,
    curve: ProbeCurve,
    name: str,
    peak: Peak,
    streams: StreamScores | None,
    absent_below: float,
) -> dict[str, Any]:
    """Return the fields of `StreamPart` of one stream."""
    view = row.view or ""
    exceeds = results.controls.exceeds(row.category, view, str(peak.site), peak.p_fwe)
    part: dict[str, Any] = {
        "stream": peak.site.stream,
        "peak": peak.score,
        "chance": None if curve.balanced else number_or_none(peak.chance),
        "site": str(peak.site),
        "layer": peak.site.layer,
        "depth": curve.depth(peak.site),
        "ties": peak.ties,
        "p_fwe": number_or_none(peak.p_fwe),
        "exceeds": exceeds,
        "remedy": results.remedy(row.category, view),
    }
    if not curve.balanced:
        if streams is not None:
            part |= {"above": streams.above(name), "above_ci": limits(streams.above_interval(name))}
        return part
    untrained = results.controls.untrained_peak(row.category, view, peak.site.stream)
    # How much more accurate the best site is than on random labels, and untrained.
    part["selectivity"] = number_or_none(peak.score - float(curve.control_accuracy[curve.sites.index(peak.site)]))
    if untrained is not None:
        part |= {"minus_untrained": untrained.difference, "minus_untrained_ci": untrained.ci}
    if streams is not None:
        most, findable = streams.at_most[name], streams.findable[name]
        part |= {
            "score": streams.accuracy(name),
            "ci": limits(streams.interval(name)),
            "peak": streams.peak(name),  # balanced between the sides too
            "at_most": most,
            "verdict": verdict(has_signal(exceeds), most, findable, absent_below),
        }
    return part


def _iterations(curve: ProbeCurve, peak: Peak | None) -> dict[str, Any]:
    """Return the iteration of the action's best site, and of a side the best layer of the first iteration.

    The first iteration has seen nothing of the action yet. A stream that runs once has neither.
    """
    if peak is None:
        return {}
    iterations = [site.iteration for site in curve.sites if site.stream == peak.site.stream]
    steps = [step for step in iterations if step is not None]
    first = best_site(curve, peak.site.stream, min(steps)) if steps and curve.balanced else None
    return {
        "iteration": peak.site.iteration,
        "first_peak": None if first is None else first.score,
        "first_layer": None if first is None else first.site.layer,
    }


def _controls(
    row: RetentionRow, results: ProbeResults, curve: ProbeCurve, peaks: Mapping[str, Peak]
) -> ControlScores:
    """Return the scores that the best sites are compared with."""
    sizes = ControlScores(n_groups=curve.n_groups, n_samples=int(curve.labels.size))
    if not curve.balanced:
        return sizes
    baselines = results.controls.of_category(row.category)
    untrained = (
        results.controls.untrained_peak(row.category, row.view or "", peak.site.stream) for peak in peaks.values()
    )
    accuracy, success = row.backbone.score, row.success.sr
    items, sides = set(curve.items.tolist()), {"left": curve.labels, "right": ~curve.labels}
    return replace(
        sizes,
        missing={
            side: 1 - len(set(curve.items[on_side].tolist())) / len(items) for side, on_side in sides.items()
        },
        probe_minus_sr=None if accuracy is None or success is None else accuracy - success,
        baselines={name: score.score for name, score in baselines.items()},
        leaks=tuple(name for name, score in baselines.items() if score.above_chance),
        untrained=next((peak.untrained for peak in untrained if peak is not None), None),
    )


def number_or_none(value: float) -> float | None:
    """Return the number, or None in place of NaN, as rows hold undefined numbers."""
    return None if isnan(value) else value


# -- targets that are no side --------------------------------------------------------------------------------


def with_corrected_p(
    row: RetentionRow, results: ProbeResults, backbone: float | None, action: float | None, tests: int
) -> RetentionRow:
    """Return a row of a label with p of both streams corrected for so many tests; None for no p.

    Args:
        row: A row of a label, with its probes.
        results: Probes of the label.
        backbone: Corrected p of the backbone.
        action: Corrected p of the action.
        tests: Number of tests that p is corrected for.
    """
    parts: dict[str, Any] = {
        name: replace(part, p_fwe=p, exceeds=part.exceeds | {"chance": p < SIGNIFICANCE})
        for name, part, p in ((BACKBONE, row.backbone, backbone), (ACTION, row.action, action))
        if p is not None
    }
    row = replace(row, **parts)
    peaks = {
        name: Peak(Site.parse(part.site), part.peak, _or_nan(part.p_fwe), chance=_or_nan(part.chance))
        for name, part in ((BACKBONE, row.backbone), (ACTION, row.action))
        if part.site is not None and part.peak is not None
    }
    above, exceeds = row.backbone.above, row.backbone.exceeds
    note, reason = missing_condition(results, row.category, row.view or "", peaks, above, exceeds, tests)
    return replace(row, retention=replace(row.retention, defined=not note, note=note, reason=reason))


def _or_nan(value: float | None) -> float:
    return nan if value is None else value


Results = Mapping[tuple[str, str], ProbeResults]
"""Probe results, by the location of a run and the target."""


def target_row(
    table_run: TableRun, results: ProbeResults, category: str, view: str, iterations: Iterations = "all"
) -> RetentionRow:
    """Return the row of a target, also of a side, in one category and view, without success.

    Args:
        table_run: The run of the row.
        results: Probes of the target.
        category: A probed category.
        view: A probed view.
        iterations: Iterations of the action's stream that take part.

    Raises:
        UnknownSiteError: If category or view was not probed.
    """
    settings, curve = results.settings, probed_curve(results, category, view)
    row = RetentionRow(
        category=category,
        view=view,
        target=settings.target,
        task=settings.task,
        run=RunInfo.of(table_run, results),
        success=SuccessRate(n_episodes=np.unique(curve.episodes).size, n_items=np.unique(curve.items).size),
    )
    return with_probes(row, results, iterations, seed_text=settings.seed_text)[0]


def with_holm_of_targets(rows: Sequence[RetentionRow], results: Results) -> list[RetentionRow]:
    """Return the rows with p of both streams corrected for the targets, within each run, category and view."""
    families: dict[tuple[str, str, str | None], list[int]] = {}
    for number, row in enumerate(rows):
        families.setdefault((row.run.location, row.category, row.view), []).append(number)
    corrected = list(rows)
    for members in families.values():
        p = [holm([getattr(rows[at], part).p_fwe for at in members]) for part in ("backbone", "action")]
        for at, backbone, action in zip(members, *p, strict=True):
            probes = results[rows[at].run.location, rows[at].target]
            corrected[at] = with_corrected_p(rows[at], probes, backbone, action, len(members))
    return corrected
