"""Retention: how much of what the backbone knows is still readable where the action is made.

That is the action expert or, in a policy without one, the positions that choose its action tokens.
"""

from dataclasses import dataclass
from math import inf, nan, sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.sites import Site
from probe_kit.retention.estimators.combined import area_fit, bounded_fit
from probe_kit.retention.estimators.cross_fit import HALVINGS, Crossfit, GroupScores, crossfit
from probe_kit.statistics.fieller import Interval, fieller_interval
from probe_kit.train.results.control_scores import BINDING, UNTRAINED, Beats, Controls, has_signal
from probe_kit.train.results.probe_curve import ProbeCurve

Iterations = Literal["all", "best", "last"] | int
"""Which iterations of the expert, or which action tokens, take part: all, the last one, or one by number.

Where one number is made of all of them it is the best one's, so that `best` is another word for `all`; a layer
curve draws a line for each of `all`, and one line for the `best` of every layer.
"""

LEAST_KNOWN = 0.25
"""Share of the backbone's score above chance that the lower end of its 95 % interval must reach.

A score that may be a quarter of what it seems makes the upper limit of the ratio four times as large; a limit
beyond that says how near the interval comes to chance, and nothing of the expert.
"""


@dataclass(frozen=True)
class Peak:
    """The best site of a stream: its held-out accuracy and family-wise p.

    ties: how many other sites of the stream are as accurate; `site` is the first of them all.
    """

    site: Site
    accuracy: float
    p_fwe: float
    ties: int = 0


@dataclass(frozen=True)
class Retention:
    """Retention of one category in one view, with the peaks it comes from.

    plain: (best expert − chance) / (best backbone − chance), the published formula; NaN if the backbone's best is
    exactly chance. defined: whether the backbone's best is above chance (family-wise), without which the ratio
    means nothing, and than binding and untrained where they were run; `note` then says so. debiased: the same
    ratio scored on episodes that had no part in choosing the sites, with its 95 % Fieller interval; fit: the two
    scores it is the ratio of. bounded: the same between that and the plug-in peaks, which are too low and too high
    on average. area: the ratio of mean scores over all sites, how much of the stack carries the answer.
    """

    chance: float
    backbone: Peak
    expert: Peak
    plain: float
    defined: bool
    note: str
    debiased: float
    interval: Interval
    fit: Crossfit
    bounded: float
    bounded_interval: Interval
    bounded_fit: Crossfit
    area: float
    area_interval: Interval
    area_fit: Crossfit


def best_site(curve: ProbeCurve, stream: str, iterations: Iterations = "all") -> Peak | None:
    """The most accurate site of `stream`, the first one on ties; None if the curve has no such stream.

    Raises UsageError if the stream has no such iteration.
    """
    rows = _rows(curve, stream, iterations)
    if rows.size == 0:
        return None
    right = curve.correct[rows].sum(axis=1)
    best = rows[np.argmax(right)]
    ties = int((right == right.max()).sum()) - 1
    return Peak(curve.sites[best], float(curve.correct[best].mean()), float(curve.p_fwe()[best]), ties)


def measure_retention(
    curve: ProbeCurve, iterations: Iterations = "all", seed: int = 0, beats: Beats | None = None
) -> Retention | None:
    """Retention of `curve`, or None if it lacks the backbone or the stream the action is made in.

    beats: what the backbone's best site is better than, as `Controls.beats` says; chance alone by default.
    Raises UsageError if that stream has no such iteration.
    """
    stream = curve.action_stream
    backbone = best_site(curve, "backbone")
    expert = None if stream is None else best_site(curve, stream, iterations)
    if stream is None or backbone is None or expert is None:
        return None
    beats = beats or Controls().beats("", "", str(backbone.site), backbone.p_fwe)
    scores = GroupScores.of(curve.correct, curve.groups)
    rows = [_rows(curve, "backbone", "all"), _rows(curve, stream, iterations)]
    streams = scores.only(rows[0]), scores.only(rows[1])
    places = tuple([curve.sites[row] for row in chosen] for chosen in rows)
    fit = crossfit(*streams, curve.chance, derive_seed("crossfit", seed))
    bounded = bounded_fit(*streams, (places[0], places[1]), curve.chance, derive_seed("crossfit", seed))
    area = area_fit(*streams, curve.chance)
    return Retention(
        chance=curve.chance,
        backbone=backbone,
        expert=expert,
        plain=_ratio(expert.accuracy - curve.chance, backbone.accuracy - curve.chance),
        defined=has_signal(beats),
        note=_note(beats),
        debiased=_ratio(fit.expert, fit.backbone),
        interval=retention_interval(fit),
        fit=fit,
        bounded=_ratio(bounded.expert, bounded.backbone),
        bounded_interval=retention_interval(bounded),
        bounded_fit=bounded,
        area=_ratio(area.expert, area.backbone),
        area_interval=retention_interval(area),
        area_fit=area,
    )


def retention_interval(fit: Crossfit) -> Interval:
    """95 % Fieller interval of the ratio of the two scores; without limits unless `backbone_is_known`."""
    if not backbone_is_known(fit):
        return Interval(-inf, inf)
    return fieller_interval(fit.expert, fit.backbone, fit.covariance, _t_quantile(_degrees(fit)))


def backbone_is_known(fit: Crossfit) -> bool:
    """Whether the backbone's score above chance is known well enough to divide by it; see LEAST_KNOWN."""
    low = fit.backbone - _t_quantile(_degrees(fit)) * sqrt(fit.covariance[1, 1])
    return fit.backbone > 0 and low >= LEAST_KNOWN * fit.backbone


def _degrees(fit: Crossfit) -> int:
    return min(fit.sizes.size - 1, HALVINGS)  # a variance is no better known than by the halvings it is from


def _rows(curve: ProbeCurve, stream: str, iterations: Iterations) -> NDArray[np.intp]:
    rows = curve.stream(stream)
    steps = {curve.sites[row].iteration for row in rows} - {None}
    if iterations in ("all", "best") or not steps:
        return rows
    step = max(filter(None, steps), default=0) if iterations == "last" else iterations
    if step not in steps:
        raise UsageError(f"the stream {stream} has iterations 0 to {len(steps) - 1}, not {step}")
    return np.array([row for row in rows if curve.sites[row].iteration == step], dtype=np.intp)


def _note(beats: Beats) -> str:
    if beats["chance"] is None:
        return "n/a (no permutations)"
    if not beats["chance"]:
        return "n/a (no backbone signal)"
    equals = [name for name in (BINDING, UNTRAINED) if beats[name] is False]
    return f"n/a (backbone no better than {' and '.join(equals)})" if equals else ""


def _ratio(numerator: float, denominator: float) -> float:
    return nan if denominator == 0 else numerator / denominator


def _t_quantile(degrees: int) -> float:
    """97.5 % quantile of Student's t."""
    from scipy.special import stdtrit  # type: ignore[import-untyped]

    return float(stdtrit(degrees, 0.975))
