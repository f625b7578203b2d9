"""Retention: how much of what the backbone knows is still readable where the action is made.

That is the action expert or, in a policy without one, the positions that choose its action tokens.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import TooFewGroupsError, UnbalancedEpisodesError, UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.retention.choices import Iterations
from probe_kit.retention.estimators.stream_scores import ACTION, BACKBONE, StreamScores, score_streams
from probe_kit.statistics.estimates.balanced import CHANCE
from probe_kit.statistics.estimates.retention import Ratio, retention
from probe_kit.statistics.estimates.verdict import ABSENT_BELOW, is_absent
from probe_kit.statistics.intervals import NO_LIMITS, Interval
from probe_kit.train.results.control_scores import RANDOM_FEATURES, UNTRAINED, Controls, Exceeds, has_signal
from probe_kit.train.results.probe_curve import ProbeCurve

NO_SCORES = "n/a (too few groups of items, or a fold with one side only)"
"""In place of retention where no score is defined."""


@dataclass(frozen=True)
class Peak:
    """The best site of a stream: its held-out score and family-wise p.

    score: of a side the accuracy, else the metric. It is too high by the luck of being chosen; `StreamScores`
    holds the score without it. chance: one half, else the mean score of the label permutations at the site; NaN
    without any. ties: how many other sites of the stream are as accurate; `site` is the first of them all.
    """

    site: Site
    score: float
    p_fwe: float
    ties: int = 0
    chance: float = CHANCE


@dataclass(frozen=True, kw_only=True)
class RetentionEstimate:
    """Retention of two streams.

    value: cross-fitted score of the action's best site over that of the backbone's, both above one half (see
    `probe_kit.statistics.estimates`); NaN where the backbone's is 0, or no score is defined. interval: 95 %,
    Fieller's; without limits where the backbone is not known well enough to divide by. published: the ratio of the
    peaks, as the paper has it. defined: whether the backbone's best site is above chance (family-wise) and better
    than every control that was run; `note` else says what is missing.
    """

    value: float
    interval: Interval
    published: float
    defined: bool
    note: str


@dataclass(frozen=True, kw_only=True)
class Retention(RetentionEstimate):
    """Retention of one target in one category and view.

    backbone, action: the best sites. streams: the scores; None with too few groups of items.
    """

    backbone: Peak
    action: Peak
    streams: StreamScores | None


def best_site(curve: ProbeCurve, stream: str, iterations: Iterations = "all") -> Peak | None:
    """Return the best site of `stream`, the first one on ties; None if the curve has no such stream.

    Of a side the most accurate one counts, else the largest score above the site's own chance. Raises UsageError
    if the stream has no such iteration.
    """
    rows = stream_rows(curve, stream, iterations)
    if rows.size == 0:
        return None
    if curve.is_side:
        right = curve.correct[rows].sum(axis=1)
        best, ties = rows[np.argmax(right)], int((right == right.max()).sum()) - 1
    else:
        best, ties = curve.largest_excess(rows), 0
    score, p = float(curve.metric[best]), float(curve.p_fwe()[best])
    return Peak(curve.sites[best], score, p, ties, float(curve.chance[best]))


def stream_peaks(curve: ProbeCurve, iterations: Iterations = "all") -> dict[str, Peak]:
    """The best sites of `backbone` and of the stream the action is made in, `action`, as far as they were probed.

    Raises UsageError if the action's stream has no such iteration.
    """
    peaks = {}
    if curve.backbone_stream is not None:
        peaks[BACKBONE] = best_site(curve, curve.backbone_stream)
    if curve.action_stream is not None:
        peaks[ACTION] = best_site(curve, curve.action_stream, iterations)
    return {name: peak for name, peak in peaks.items() if peak is not None}


def curve_scores(curve: ProbeCurve, iterations: Iterations = "all", seed_text: str = "") -> StreamScores | None:
    """Cross-fitted scores of the backbone and of the stream the action is made in, as far as they were probed.

    None with too few groups, or where a fold was trained on one side only: then no score is defined.
    """
    rows = {ACTION: _rows(curve, curve.action_stream, iterations), BACKBONE: _rows(curve, curve.backbone_stream)}
    try:
        return score_streams(
            curve, {name: of_stream for name, of_stream in rows.items() if of_stream.size}, seed_text
        )
    except (TooFewGroupsError, UnbalancedEpisodesError):
        return None


def measure_retention(
    curve: ProbeCurve, iterations: Iterations = "all", seed_text: str = "", exceeds: Exceeds | None = None
) -> Retention | None:
    """Retention of `curve`, or None if it lacks the backbone or the stream the action is made in.

    seed_text: of the run; scores on equal groups of one are paired. exceeds: what the backbone's best site is
    better than, as `Controls.exceeds` says; chance alone by default. Raises UsageError if the
    action's stream has no such iteration.
    """
    peaks = stream_peaks(curve, iterations)
    if len(peaks) < 2:
        return None
    backbone = peaks[BACKBONE]
    exceeds = exceeds or Controls().exceeds("", "", str(backbone.site), backbone.p_fwe)
    streams = curve_scores(curve, iterations, seed_text)
    estimate = estimate_retention(peaks, streams, exceeds)
    return Retention(backbone=backbone, action=peaks[ACTION], streams=streams, **vars(estimate))


def estimate_retention(
    peaks: Mapping[str, Peak], streams: StreamScores | None, exceeds: Exceeds, absent_below: float = ABSENT_BELOW
) -> RetentionEstimate:
    """Retention of the best sites `action` and `backbone`, with the streams' scores.

    exceeds: what the backbone's best site is better than. absent_below: see `verdict`.
    """
    if streams is None:
        published = _published(peaks[ACTION].score, peaks[BACKBONE].score)
        return RetentionEstimate(value=nan, interval=NO_LIMITS, published=published, defined=False, note=NO_SCORES)
    ratio: Ratio = retention(streams.scores)
    return RetentionEstimate(
        value=ratio.value,
        interval=ratio.interval,
        published=_published(streams.peak(ACTION), streams.peak(BACKBONE)),
        defined=has_signal(exceeds),
        note=_missing_signal(exceeds, streams, absent_below) if streams.at_most else "",
    )


def _published(action: float, backbone: float) -> float:
    """The paper's ratio, of the accuracies of the best sites above one half; NaN where the backbone's is 0."""
    return nan if backbone == CHANCE else float((action - CHANCE) / (backbone - CHANCE))


def _missing_signal(exceeds: Exceeds, streams: StreamScores, absent_below: float) -> str:
    """Why there is nothing to retain; empty where the backbone's signal is shown."""
    if exceeds["chance"] is None:
        return "n/a (no permutations)"
    if not exceeds["chance"]:
        most = f"{100 * streams.at_most[BACKBONE]:.0f} %"
        absent = is_absent(streams.at_most[BACKBONE], streams.findable[BACKBONE], absent_below)
        return (
            f"n/a (backbone absent, at most {most})"
            if absent
            else f"n/a (backbone not shown, could be up to {most})"
        )
    equals = [name for name in (RANDOM_FEATURES, UNTRAINED) if exceeds[name] is False]
    return f"n/a (backbone not shown to beat {' and '.join(equals)})" if equals else ""


def stream_rows(curve: ProbeCurve, stream: str, iterations: Iterations) -> NDArray[np.intp]:
    """Positions of a stream's sites at these iterations. Raises UsageError if it has no such iteration."""
    rows = curve.stream(stream)
    step = known_iteration(stream, [curve.sites[row].iteration for row in rows], iterations)
    if step is None:
        return rows
    return np.array([row for row in rows if curve.sites[row].iteration == step], dtype=np.intp)


def known_iteration(stream: str, every: Sequence[int | None], iterations: Iterations) -> int | None:
    """The one iteration that takes part; None for all, and of a stream that runs once.

    every: the iterations of its sites. Raises UsageError if it has no such iteration.
    """
    steps = set(every) - {None}
    if iterations in ("all", "best") or not steps:
        return None
    step = max(filter(None, steps), default=0) if iterations == "last" else iterations
    if step not in steps:
        raise UsageError(f"the stream {stream} has iterations 0 to {len(steps) - 1}, not {step}")
    return int(step)


def _rows(curve: ProbeCurve, stream: str | None, iterations: Iterations = "all") -> NDArray[np.intp]:
    return np.empty(0, np.intp) if stream is None else stream_rows(curve, stream, iterations)
