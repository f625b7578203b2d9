"""Retention of a label: share of the backbone's score above chance that is left in the action."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

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
        """What the site is not shown to exceed: chance and controls, by name."""
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
    own = results.settings
    view, category = view or own.views[0], category or own.categories[0]
    if (category, view) not in results.curves:
        raise UnknownSiteError(f"view {view!r} was not probed; probed: {', '.join(own.views)}")
    curve = results.curves[category, view]
    rows = {ACTION: _rows(curve, ACTION, iterations), BACKBONE: _rows(curve, BACKBONE, "all")}
    above = [curve.fit_stream(of_part) for of_part in rows.values()]
    scores = Scores.of(crossfit(above, list(curve.group_names), own.seed_text, chance=0.0))
    action, backbone = (
        _peak(results, (category, view), of_part, scores, place) for place, of_part in enumerate(rows.values())
    )
    ratio: Ratio = retention(scores)
    note, reason = _refusal(results, category, backbone)
    return LabelRetention(
        view=view,
        category=category,
        target=own.target,
        task=own.task,
        metric=METRICS[own.task],
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
    found: LabelRetention, results: ProbeResults, backbone: float | None, action: float | None
) -> LabelRetention:
    """The same with p of both streams corrected for further tests; None for no p. results: what it is made of."""
    peaks = [
        one if p is None else replace(one, p_fwe=p)
        for one, p in ((found.backbone, backbone), (found.action, action))
    ]
    note, reason = _refusal(results, found.category, peaks[0])
    return replace(found, backbone=peaks[0], action=peaks[1], note=note, reason=reason)


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
    results: ProbeResults, curve_of: tuple[str, str], rows: NDArray[np.intp], scores: Scores, place: int
) -> LabelPeak:
    curve = results.curves[curve_of]
    best = curve.largest_excess(rows)
    above = float(scores.above[place])
    spread = t_quantile(scores.df) * sqrt(scores.covariance[place, place])
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


def _refusal(results: ProbeResults, category: str, backbone: LabelPeak) -> tuple[str, str]:
    """Why there is nothing to retain, in few words and in full; two empty texts where there is."""
    own, score = results.settings, METRICS[results.settings.task]
    found = f"the backbone's best site {backbone.site} has {score} {backbone.score:.2f}"
    if backbone.p_fwe != backbone.p_fwe:
        return "n/a (no permutations)", (
            f"{found}, and no permuted labels say what chance is. Train with --permutations 200, on groups that "
            "can exchange labels"
        )
    if own.window > 1 and STEP not in results.controls.names:
        return "n/a (control step was not run)", (
            f"{found}, and labels change within episodes, so their step may say as much. Train with the control "
            f"step: `--controls {','.join([STEP, *results.controls.names])}`"
        )
    if missed := backbone.missed:
        scores = {
            one.name: one.score
            for one in results.controls.scores
            if one.category == category and one.stream in ("", backbone.stream)
        }
        facts = [f"chance {backbone.chance:.2f}, p {backbone.p_fwe:.3f}"]
        facts += [f"{name} {scores[name]:.2f}" for name in missed if name in scores]
        return f"n/a (backbone not shown to exceed {_listed(missed)})", (
            f"{found} ({'; '.join(facts)}). Expected p < {SIGNIFICANCE} and more than every control that was run. "
            "Label more groups, or choose a label that these controls do not decode"
        )
    if own.task == "continuous" and backbone.above < LEAST_EXCESS:
        return f"n/a (backbone {backbone.above:.2f} above chance)", (
            f"{found}, {backbone.above:.2f} above chance where a site is chosen on other groups; expected "
            f"{LEAST_EXCESS} or more to divide by. Label more groups"
        )
    return "", ""


def _listed(names: tuple[str, ...]) -> str:
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def check_same_label(results: Sequence[ProbeResults], places: Sequence[str]) -> None:
    """Raise UsageError where results at two places are of labels that differ in any value or sample."""
    first = results[0]
    for one, place in zip(results, places, strict=True):
        if one.settings.label != first.settings.label:
            raise UsageError(
                f"the labels {one.settings.target!r} of {place} and {places[0]} differ "
                f"(sha256 {one.settings.label[:12]} and {first.settings.label[:12]}); retention is compared on "
                "the same labels of the same episodes. Show the runs one by one"
            )
