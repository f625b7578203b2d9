"""Retention of a label: share of the backbone's score above chance that is left in the action."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import enumerated
from probe_kit.errors import NoProbesError, UnknownSiteError, UsageError
from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.estimators.retention import Iterations, stream_rows
from probe_kit.retention.estimators.stream_scores import ACTION, BACKBONE, Limits, limits
from probe_kit.statistics.estimates.crossfit import crossfit
from probe_kit.statistics.estimates.retention import Ratio, retention
from probe_kit.statistics.estimates.scores import Scores, t_quantile
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

LEAST_EXCESS = 0.05
"""R² above chance that the backbone must have; a ratio of less is the ratio of two errors."""
STEP = "step"


@dataclass(frozen=True, kw_only=True)
class LabelPeak:
    """The score of a label in one stream.

    above: score above chance of the sites that the inner folds choose, on the outer folds; ci: its 95 % interval,
    Student's. site: of the largest score above its own chance; score, chance, p_fwe: of that site. exceeds: by
    control that was run, whether the site exceeds it.
    """

    stream: str
    site: str
    score: float
    chance: float
    p_fwe: float
    exceeds: dict[str, bool]
    above: float
    ci: Limits

    @property
    def missed(self) -> tuple[str, ...]:
        """The names of chance and controls that the site is not shown to exceed."""
        below = ("chance",) * (not self.p_fwe < SIGNIFICANCE)
        return (*below, *(name for name, exceeded in self.exceeds.items() if not exceeded))

    @property
    def has_signal(self) -> bool:
        """Whether it is above chance and exceeds every control that was run."""
        return not self.missed

    @property
    def is_marked(self) -> bool:
        """Whether it has signal and was compared with a control, and not with chance alone."""
        return self.has_signal and bool(self.exceeds)


@dataclass(frozen=True, kw_only=True)
class LabelRetention:
    """Retention of one label in one view.

    value: score of the action above chance over that of the backbone; ci: 95 %, Fieller's, (None, None) where the
    backbone is not known well enough to divide by. defined: whether the backbone has signal to retain; note else
    names what is missing, and reason says what was found, what was expected and what to do.
    """

    view: str
    category: str
    target: str
    task: str
    metric: str
    backbone: LabelPeak
    action: LabelPeak
    value: float
    ci: Limits
    n_groups: int
    n_samples: int
    note: str = ""
    reason: str = ""

    @property
    def defined(self) -> bool:
        """Whether there is something to retain."""
        return not self.note


def measure_label_retention(
    results: ProbeResults,
    view: str | None = None,
    iterations: Iterations = "all",
    category: str | None = None,
) -> LabelRetention:
    """Retention of the label that `results` are of.

    view, category: the first probed one by default. From every sample's score the chance of its site is
    subtracted, which is the mean score of the label permutations there. In every outer fold sites are chosen by
    the inner folds, as for sides; see `probe_kit.statistics.estimates`. Raises UnknownSiteError for a view that
    was not probed, NoProbesError for a run without backbone or action, and UsageError for an iteration that the
    action does not have.
    """
    settings = results.settings
    view, category = view or settings.views[0], category or settings.categories[0]
    if (category, view) not in results.curves:
        raise UnknownSiteError(f"view {view!r} was not probed; probed: {', '.join(settings.views)}")
    curve = results.curves[category, view]
    rows = {ACTION: _rows(curve, ACTION, iterations), BACKBONE: _rows(curve, BACKBONE, "all")}
    above = [curve.fit_stream(of_part) for of_part in rows.values()]
    scores = Scores.of(crossfit(above, list(curve.group_names), settings.seed_text, chance=0.0))
    action, backbone = (
        _peak(results, (category, view), of_part, scores, number) for number, of_part in enumerate(rows.values())
    )
    ratio: Ratio = retention(scores)
    note, reason = _refusal(results, (category, view), backbone)
    return LabelRetention(
        view=view,
        category=category,
        target=settings.target,
        task=settings.task,
        metric=METRICS[settings.task],
        backbone=backbone,
        action=action,
        value=ratio.value,
        ci=limits(ratio.interval),
        n_groups=curve.n_groups,
        n_samples=int(curve.labels.size),
        note=note,
        reason=reason,
    )


def with_corrected_p(
    estimate: LabelRetention, results: ProbeResults, backbone: float | None, action: float | None, tests: int
) -> LabelRetention:
    """Return the same with p of both streams corrected for so many tests; None for no p.

    results: what it is made of.
    """
    peaks = [
        peak if p is None else replace(peak, p_fwe=p)
        for peak, p in ((estimate.backbone, backbone), (estimate.action, action))
    ]
    note, reason = _refusal(results, (estimate.category, estimate.view), peaks[0], tests)
    return replace(estimate, backbone=peaks[0], action=peaks[1], note=note, reason=reason)


def _rows(curve: ProbeCurve, part: str, iterations: Iterations) -> NDArray[np.intp]:
    """Positions of the sites of a part of the model. Raises NoProbesError without any."""
    stream = curve.of_part(part)
    if stream is None:
        raise NoProbesError(
            f"no site of the {part} was probed, so there is no retention; probed: "
            f"{', '.join(dict.fromkeys(label_of(site.stream) for site in curve.sites))}. Extract a policy whose "
            "backbone and action stream are captured"
        )
    return stream_rows(curve, stream, iterations)


def _peak(
    results: ProbeResults, curve_of: tuple[str, str], rows: NDArray[np.intp], scores: Scores, number: int
) -> LabelPeak:
    curve = results.curves[curve_of]
    best = curve.largest_excess(rows)
    above = float(scores.above[number])
    spread = t_quantile(scores.df) * sqrt(scores.covariance[number, number])
    site = curve.sites[best]
    return LabelPeak(
        stream=site.stream,
        site=str(site),
        score=float(curve.metric[best]),
        chance=float(curve.chance[best]),
        p_fwe=float(curve.p_fwe()[best]),
        exceeds=results.controls.exceeded(*curve_of, site),
        above=above,
        ci=(above - spread, above + spread),
    )


def _refusal(
    results: ProbeResults, curve_of: tuple[str, str], backbone: LabelPeak, tests: int = 1
) -> tuple[str, str]:
    """Return why there is nothing to retain, in few words and in full; two empty texts where there is."""
    category, _ = curve_of
    settings, score = results.settings, METRICS[results.settings.task]
    best = f"the backbone's best site {backbone.site} has {score} {backbone.score:.2f}"
    if backbone.p_fwe != backbone.p_fwe:
        return "n/a (no permutations)", (
            f"{best}, and no permuted labels say what chance is. Train with --permutations 200, on groups that "
            "can exchange labels"
        )
    if settings.window > 1 and STEP not in results.controls.names:
        return "n/a (control step was not run)", (
            f"{best}, and labels change within episodes, so their step may say as much. Train with the control "
            f"step: `--controls {','.join([STEP, *results.controls.names])}`"
        )
    if missed := backbone.missed:
        scores = {
            control.name: control.score
            for control in results.controls.scores
            if control.category == category and control.stream in ("", backbone.stream)
        }
        facts = [f"chance {backbone.chance:.2f}, p {backbone.p_fwe:.3f}"]
        facts += [f"{name} {scores[name]:.2f}" for name in missed if name in scores]
        advice = "Label more groups, or choose a label that these controls do not decode"
        if remedy := results.remedy(*curve_of, tests):
            advice = f"No p can be below it: {remedy}"
        return f"n/a (backbone not shown to exceed {enumerated(missed)})", (
            f"{best} ({'; '.join(facts)}). Expected p < {SIGNIFICANCE} and more than every control that was run. "
            f"{advice}"
        )
    if settings.task == "continuous" and backbone.above < LEAST_EXCESS:
        return f"n/a (backbone {backbone.above:.2f} above chance)", (
            f"{best}, {backbone.above:.2f} above chance where a site is chosen on other groups; expected "
            f"{LEAST_EXCESS} or more to divide by. Label more groups"
        )
    return "", ""


def check_same_label(results: Sequence[ProbeResults], places: Sequence[str]) -> None:
    """Raise UsageError where results at two places are of labels that differ in any value or sample."""
    first = results[0]
    for probes, location in zip(results, places, strict=True):
        if probes.settings.label != first.settings.label:
            raise UsageError(
                f"the labels {probes.settings.target!r} of {location} and {places[0]} differ "
                f"(sha256 {probes.settings.label[:12]} and {first.settings.label[:12]}); retention is compared on "
                "the same labels of the same episodes. Show the runs one by one"
            )
