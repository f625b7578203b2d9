"""Retention: how much of what the backbone knows is still readable in the action expert."""

from dataclasses import dataclass
from math import nan
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.sites import Site
from probe_kit.identity import derive_seed
from probe_kit.retention.crossfit import GroupScores, crossfit
from probe_kit.retention.fieller import Interval, fieller_interval
from probe_kit.train.controls import SIGNIFICANCE
from probe_kit.train.curve import Curve

Iterations = Literal["all", "last"] | int
"""Which expert iterations take part: all of them, the last one, or one by number."""


@dataclass(frozen=True)
class Peak:
    """The best site of a stream: its held-out accuracy and family-wise p."""

    site: Site
    accuracy: float
    p_fwe: float


@dataclass(frozen=True)
class Retention:
    """Retention of one category in one view, with the peaks it comes from.

    plain: (best expert − chance) / (best backbone − chance), the published formula; NaN if the backbone's best is
    exactly chance. defined: whether the backbone's best is above chance (family-wise), without which the ratio
    means nothing; `note` then says so. debiased: the same ratio scored on episodes that had no part in choosing
    the sites, with its 95 % Fieller interval; held_out: those episodes' correct decisions, as in `Crossfit`.
    """

    chance: float
    backbone: Peak
    expert: Peak
    plain: float
    defined: bool
    note: str
    debiased: float
    interval: Interval
    held_out: NDArray[np.float64]


def best_site(curve: Curve, stream: str, iterations: Iterations = "all") -> Peak | None:
    """The most accurate site of `stream`, the first one on ties; None if the curve has no such stream.

    Raises UsageError if the stream has no such iteration.
    """
    rows = _rows(curve, stream, iterations)
    if rows.size == 0:
        return None
    accuracy = curve.correct[rows].mean(axis=1)
    best = rows[np.argmax(accuracy)]
    return Peak(curve.sites[best], float(accuracy.max()), float(curve.p_fwe()[best]))


def measure_retention(curve: Curve, iterations: Iterations = "all", seed: int = 0) -> Retention | None:
    """Retention of `curve`, or None if it lacks the backbone or the expert stream.

    Raises UsageError if the expert has no such iteration.
    """
    backbone, expert = best_site(curve, "backbone"), best_site(curve, "expert", iterations)
    if backbone is None or expert is None:
        return None
    scores = GroupScores.of(curve.correct, curve.groups)
    fit = crossfit(
        scores.only(_rows(curve, "backbone", "all")),
        scores.only(_rows(curve, "expert", iterations)),
        curve.chance,
        derive_seed("crossfit", seed),
    )
    return Retention(
        chance=curve.chance,
        backbone=backbone,
        expert=expert,
        plain=_ratio(expert.accuracy - curve.chance, backbone.accuracy - curve.chance),
        defined=backbone.p_fwe < SIGNIFICANCE,
        note=_note(backbone.p_fwe),
        debiased=_ratio(fit.expert, fit.backbone),
        interval=fieller_interval(fit.expert, fit.backbone, fit.covariance, _t_quantile(curve.n_groups - 1)),
        held_out=fit.held_out,
    )


def _rows(curve: Curve, stream: str, iterations: Iterations) -> NDArray[np.intp]:
    rows = curve.stream(stream)
    steps = {curve.sites[row].iteration for row in rows} - {None}
    if iterations == "all" or not steps:
        return rows
    step = max(filter(None, steps), default=0) if iterations == "last" else iterations
    if step not in steps:
        raise UsageError(f"the expert has iterations 0 to {len(steps) - 1}, not {step}")
    return np.array([row for row in rows if curve.sites[row].iteration == step], dtype=np.intp)


def _note(p_fwe: float) -> str:
    if np.isnan(p_fwe):
        return "n/a (no permutations)"
    return "" if p_fwe < SIGNIFICANCE else "n/a (no backbone signal)"


def _ratio(numerator: float, denominator: float) -> float:
    return nan if denominator == 0 else numerator / denominator


def _t_quantile(degrees: int) -> float:
    """97.5 % quantile of Student's t."""
    from scipy.special import stdtrit  # type: ignore[import-untyped]

    return float(stdtrit(degrees, 0.975))
