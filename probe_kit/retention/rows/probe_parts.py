"""The parts of a row that probes give, and rows of targets that are no side, which have no others."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import isnan
from typing import Any

import numpy as np

from probe_kit._system.counting import counted, enumerated
from probe_kit._tables.numbers import p_text
from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.retention.behaviour import SuccessRate
from probe_kit.retention.choices import Family, Iterations
from probe_kit.retention.estimators import (
    ACTION,
    BACKBONE,
    Peak,
    StreamScores,
    best_site,
    curve_scores,
    estimate_retention,
    limits,
    stream_peaks,
)
from probe_kit.retention.rows.row import (
    ActionPart,
    BackbonePart,
    ControlScores,
    RetentionPart,
    RetentionRow,
    RunInfo,
)
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.paired_tests import holm
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.sufficiency import ABSENT_BELOW, verdict
from probe_kit.train.choices import SIDES
from probe_kit.train.results.control_scores import has_signal
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import load_results, stored_targets

LEAST_EXCESS = 0.05
"""R² above chance that the backbone must have; a ratio of less is the ratio of two errors."""
STEP = "step"
"""The control that labels of several inferences need: the number of the inference alone may say as much."""
NO_STEP = "n/a (control step was not run)"


def with_probes(
    row: RetentionRow,
    results: ProbeResults,
    iterations: Iterations = "all",
    absent_below: float = ABSENT_BELOW,
    seed_text: str = "",
) -> tuple[RetentionRow, StreamScores | None]:
    """Return the row with the parts of its category's probes, and their scores; None where there are none.

    seed_text: of the run; scores on equal groups of one are paired. absent_below: see `verdict`.
    """
    curve = None if row.view is None else results.curves.get((row.category, row.view))
    if row.view is None or curve is None:
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
    estimate = RetentionPart(note="n/a (one stream only)")
    if len(peaks) == 2:
        ratio = estimate_retention(peaks, streams, parts[BACKBONE]["exceeds"], absent_below)
        estimate = RetentionPart(
            value=number_or_none(ratio.value),
            ci=limits(ratio.interval),
            # The paper's ratio is of accuracies above one half, which the metric of a label is not.
            published=number_or_none(ratio.published) if curve.is_side else None,
            defined=ratio.defined,
            note=ratio.note,
        )
    row = replace(row, retention=estimate, controls=_controls(row, results, curve, peaks))
    return row if curve.is_side else with_reason(row, results), streams


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
        "chance": None if curve.is_side else number_or_none(peak.chance),
        "site": str(peak.site),
        "layer": peak.site.layer,
        "depth": curve.depth(peak.site),
        "ties": peak.ties,
        "p_fwe": number_or_none(peak.p_fwe),
        "exceeds": exceeds,
        "remedy": results.remedy(row.category, view),
    }
    if not curve.is_side:
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
    first = best_site(curve, peak.site.stream, min(steps)) if steps and curve.is_side else None
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
    if not curve.is_side:
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
            side: 1 - len(set(curve.items[is_side].tolist())) / len(items) for side, is_side in sides.items()
        },
        probe_minus_sr=None if accuracy is None or success is None else accuracy - success,
        baselines={name: score.score for name, score in baselines.items()},
        leaks=tuple(name for name, score in baselines.items() if score.above_chance),
        untrained=next((peak.untrained for peak in untrained if peak is not None), None),
    )


def number_or_none(value: float) -> float | None:
    """Return None in place of NaN, as rows hold a number that there is not."""
    return None if isnan(value) else value


# -- targets that are no side --------------------------------------------------------------------------------


def with_reason(row: RetentionRow, results: ProbeResults, tests: int = 1) -> RetentionRow:
    """Return a row of a label that says whether there is something to retain, and else what is missing.

    tests: the number that p is corrected for.
    """
    note, reason = _missing(row, results, tests)
    return replace(row, retention=replace(row.retention, defined=not note, note=note, reason=reason))


def with_corrected_p(
    row: RetentionRow, results: ProbeResults, backbone: float | None, action: float | None, tests: int
) -> RetentionRow:
    """Return a row of a label with p of both streams corrected for so many tests; None for no p."""
    parts: dict[str, Any] = {
        name: replace(part, p_fwe=p, exceeds=part.exceeds | {"chance": p < SIGNIFICANCE})
        for name, part, p in ((BACKBONE, row.backbone, backbone), (ACTION, row.action, action))
        if p is not None
    }
    return with_reason(replace(row, **parts), results, tests)


def _missing(row: RetentionRow, results: ProbeResults, tests: int) -> tuple[str, str]:
    """Return why there is nothing to retain, in few words and in full; two empty texts where there is."""
    settings, backbone = results.settings, row.backbone
    if backbone.peak is None or row.action.peak is None:
        part = "backbone" if backbone.peak is None else "action"
        probed = ", ".join(
            dict.fromkeys(site.stream for site in results.curves[row.category, row.view or ""].sites)
        )
        return "n/a (one stream only)", (
            f"no site of the {part} was probed, so there is no retention; probed: {probed}. Extract a policy "
            "whose backbone and action stream are captured"
        )
    best = f"the backbone's best site {backbone.site} has {row.metric} {backbone.peak:.2f}"
    if backbone.p_fwe is None or backbone.chance is None:
        return "n/a (no permutations)", (
            f"{best}, and no permuted labels say what chance is. Train with --permutations 200, on groups that "
            "can exchange labels"
        )
    if settings.window > 1 and STEP not in results.controls.names:
        return NO_STEP, (
            f"{best}, and labels change within episodes, so their step may say as much. Train with the control "
            f"step: `--controls {','.join([STEP, *results.controls.names])}`"
        )
    if missed := backbone.missed:
        scores = {
            control.name: control.score
            for control in results.controls.scores
            if control.category == row.category and control.stream in ("", backbone.stream)
        }
        facts = [f"chance {backbone.chance:.2f}, p {p_text(backbone.p_fwe)}"]
        facts += [f"{name} {scores[name]:.2f}" for name in missed if name in scores]
        advice = "Label more groups, or choose a label that these controls do not decode"
        if remedy := results.remedy(row.category, row.view or "", tests):
            advice = f"No p can be below it: {remedy}"
        return f"n/a (backbone not shown to exceed {enumerated(missed)})", (
            f"{best} ({'; '.join(facts)}). Expected p < {SIGNIFICANCE} and more than every control that was run. "
            f"{advice}"
        )
    if row.backbone.above is None:
        return row.retention.note, f"{best}, and too few groups to choose a site on others. Label more groups"
    if row.task == "continuous" and row.backbone.above < LEAST_EXCESS:
        return f"n/a (backbone {row.backbone.above:.2f} above chance)", (
            f"{best}, {row.backbone.above:.2f} above chance where a site is chosen on other groups; expected "
            f"{LEAST_EXCESS} or more to divide by. Label more groups"
        )
    return "", ""


Results = Mapping[tuple[str, str], ProbeResults]
"""By the location of a run and the target."""
_NAMED = 8
"""Labels of a run that a sentence names."""


def read_labels(
    runs: Sequence[RunReader], targets: Sequence[str], keys: Sequence[str | None]
) -> dict[tuple[str, str], ProbeResults]:
    """Return the stored probes of every target in every run.

    keys: which ones of each run, the newest by default; with one target only. Raises NoProbesError for a run
    without probes of a target, UsageError for a side, a target given twice, a key of another target, and several
    runs whose labels differ.
    """
    if sides := [name for name in targets if name in SIDES]:
        raise UsageError(
            f"the target {sides[0]!r} is the name of a side. Leave --target out for the retention of sides"
        )
    if doubles := [name for at, name in enumerate(targets) if name in targets[:at]]:
        raise UsageError(f"the target {doubles[0]!r} is given twice; leave one out")
    if len(targets) > 1 and any(keys):
        raise UsageError(
            f"stored probes are chosen by key for {len(targets)} targets ({', '.join(targets)}); a key is of one. "
            "Show one target at a time, or leave the keys out"
        )
    results: dict[tuple[str, str], ProbeResults] = {}
    for target in targets:
        of_target = [load_results(run, key, target) for run, key in zip(runs, keys, strict=True)]
        _check_same_label(of_target, runs)
        results |= {(str(run.location), target): of_run for run, of_run in zip(runs, of_target, strict=True)}
    return results


def _check_same_label(results: Sequence[ProbeResults], runs: Sequence[RunReader]) -> None:
    """Raise UsageError where results of two runs are of labels that differ in any value or sample."""
    first = results[0]
    for of_run, run in zip(results, runs, strict=True):
        if of_run.settings.label != first.settings.label:
            raise UsageError(
                f"the labels {of_run.settings.target!r} of {run.location} and {runs[0].location} differ "
                f"(sha256 {of_run.settings.label[:12]} and {first.settings.label[:12]}); retention is compared on "
                "the same labels of the same episodes. Show the runs one by one"
            )


def label_rows(
    runs: Sequence[RunReader],
    results: Results,
    views: Sequence[str] | None = None,
    iterations: Iterations = "all",
    family: Family = "label",
) -> list[RetentionRow]:
    """Return a row per target, run, category and view; views: those that were probed by default.

    family: `table` corrects p for all targets by Holm's method, per run, category, view and stream. Raises
    UnknownSiteError for a view that was not probed, UsageError for an iteration that the action does not have.
    """
    run_of = {str(run.location): run for run in runs}
    rows = [
        target_row(run_of[location], probes, category, view, iterations)
        for (location, _), probes in results.items()
        for category in probes.settings.categories
        for view in views or probes.settings.views
    ]
    return rows if family == "label" else _corrected(rows, results)


def target_row(
    run: RunReader, results: ProbeResults, category: str, view: str, iterations: Iterations = "all"
) -> RetentionRow:
    """Return the row of a target, also of a side, in one category and view, without success.

    Raises UnknownSiteError if it was not probed.
    """
    settings = results.settings
    if (category, view) not in results.curves:
        raise UnknownSiteError(f"view {view!r} was not probed; probed: {', '.join(settings.views)}")
    curve = results.curves[category, view]
    row = RetentionRow(
        category=category,
        view=view,
        target=settings.target,
        task=settings.task,
        run=RunInfo.of(run, results),
        success=SuccessRate(n_episodes=np.unique(curve.episodes).size, n_items=np.unique(curve.items).size),
    )
    return with_probes(row, results, iterations, seed_text=settings.seed_text)[0]


def _corrected(rows: Sequence[RetentionRow], results: Results) -> list[RetentionRow]:
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


# -- what a reader must know ---------------------------------------------------------------------------------


def label_notes(
    runs: Sequence[RunReader], rows: Sequence[RetentionRow], family: Family, names: Mapping[str, str]
) -> Iterator[str]:
    """Yield a warning where a signal was compared with no control, and how many labels were tried in each run.

    names: of the runs, by location.
    """
    bare = [row for row in rows if row.backbone.peak is not None and not row.backbone.is_controlled]
    if bare:
        of_runs = ", ".join(dict.fromkeys(f"{row.target} of {names[row.run.location]}" for row in bare))
        yield f"No control was run for {of_runs}: a signal there is judged against chance only."
    count = len({row.target for row in rows})
    corrected = (
        "of each label alone" if family == "label" else f"corrected for the {count} labels of this table (Holm)"
    )
    for run in runs:
        tried = stored_targets(run)
        if sum(tried.values()) > 1:
            yield f"{names[str(run.location)]} has probes of {_in_words(tried)}; p is {corrected}."


def _in_words(tried: Mapping[str, int]) -> str:
    """Return how many labels a run has probes of; one whose values changed counts again."""
    words = [f"{name} in {of} versions" if of > 1 else name for name, of in tried.items()]
    first = ", ".join([*words[:_NAMED], *["…"] * (len(words) > _NAMED)])
    return f"{counted(sum(tried.values()), 'label')} ({first})"
