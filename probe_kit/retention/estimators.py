"""The scores of a category's streams, and retention: the share of the backbone's signal that the action keeps.

The score of a stream is the held-out accuracy of a site that was chosen on the training questions. Retention is
the score of the action above chance, divided by that of the backbone. The action is read in the action expert. In
a policy without one it is read at the positions that choose the action's tokens.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isnan, nan, sqrt

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.counting import list_names
from probe_kit._tables.numbers import Limits, p_text
from probe_kit.errors import TooFewGroupsError, UnbalancedEpisodesError, UnknownSiteError, UsageError
from probe_kit.hooks.contract.sites import Site
from probe_kit.retention.choices import Iterations
from probe_kit.statistics.crossfit import CHANCE, CrossFit, crossfit
from probe_kit.statistics.intervals import (
    NO_LIMITS,
    Interval,
    Share,
    allowing_for_unseen_groups,
    correlation_of,
    difference_interval,
    mean_interval,
)
from probe_kit.statistics.retention import Ratio, Scores, accuracy_interval, retention, t_quantile
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.statistics.sufficiency import ABSENT_BELOW, at_most, findable, is_absent, permuted_threshold
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.results.control_scores import Controls, Exceeds, has_signal, missed_controls
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

ACTION, BACKBONE = "action", "backbone"
"""Names of the two streams, in the order of the scores: retention is the first over the second."""


def limits(interval: Interval) -> Limits:
    """Return the interval as two numbers; (None, None) where it has no limits."""
    return (interval.low, interval.high) if interval.bounded else (None, None)


@dataclass(frozen=True)
class StreamScores:
    """Cross-fitted scores of K streams of one category and view.

    Attributes:
        names: `action` and `backbone` in this order, as far as they were probed.
        fit: Their scores, on the same groups.
        at_most: Of a side, by name, an upper limit of the best site's accuracy, see `sufficiency.at_most`.
        findable: Of a side, by name, the least accuracy of a site that such items find, see
            `sufficiency.findable`.
    """

    names: tuple[str, ...]
    fit: CrossFit
    at_most: Mapping[str, float] = field(default_factory=dict)
    findable: Mapping[str, float] = field(default_factory=dict)

    @property
    def scores(self) -> Scores:
        """Scores above one half with their covariance."""
        return Scores.of(self.fit)

    def above(self, name: str) -> float:
        """Return the score above chance of the sites that the inner folds choose, on the outer folds."""
        return float(self.fit.above[self.names.index(name)])

    def above_interval(self, name: str) -> Interval:
        """Return the 95 % interval of the score above chance, Student's."""
        row, scores = self.names.index(name), self.scores
        spread = t_quantile(scores.df) * sqrt(scores.covariance[row, row])
        return Interval(self.above(name) - spread, self.above(name) + spread)

    def accuracy(self, name: str) -> float:
        """Return the accuracy of the sites of a side that the inner folds choose, on the outer folds."""
        return CHANCE + self.above(name)

    def interval(self, name: str) -> Interval:
        """Return the 95 % interval of the accuracy (Wilson)."""
        return accuracy_interval(self.fit, self.names.index(name))

    def peak(self, name: str) -> float:
        """Return the accuracy of the site that is best on all groups, scored on them too."""
        return float(self.fit.peaks[self.names.index(name)])

    def as_of(self, seed_text: str) -> "StreamScores":
        """Return the same scores, their groups taken to be those of another run's suite.

        Items in common may come from that suite.
        """
        return replace(self, fit=replace(self.fit, suite=seed_text))


def score_streams(curve: ProbeCurve, rows: Mapping[str, NDArray[np.intp]], seed_text: str) -> StreamScores | None:
    """Return the scores of streams by their rows of a curve; None without any.

    Args:
        curve: Probes of one category in one view.
        rows: Positions of each stream's sites in the curve, by name.
        seed_text: Seed text of the run; scores on equal groups of one are paired.

    Raises:
        TooFewGroupsError: For fewer than 5 groups.
        UnbalancedEpisodesError: For a fold trained on one side only.
    """
    if not rows:
        return None
    streams = {name: curve.fit_stream(of_stream) for name, of_stream in rows.items()}
    if not curve.balanced:  # chance differs between sites and is subtracted from each
        return StreamScores(
            tuple(rows), crossfit(list(streams.values()), curve.group_names, seed_text, chance=0.0)
        )
    fit = crossfit(list(streams.values()), curve.group_names, seed_text)
    thresholds = {name: permuted_threshold(curve.null[of_stream]) for name, of_stream in rows.items()}
    return StreamScores(
        tuple(rows),
        fit,
        {name: at_most(stream.scores) for name, stream in streams.items()},
        {name: findable(stream.scores, thresholds[name]) for name, stream in streams.items()},
    )


# -- averages and differences --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rate:
    """A share of episodes with its 95 % interval.

    Attributes:
        share: The share by groups; None where the rate averages over other groups.
    """

    value: float
    interval: Interval
    share: Share | None = None

    @classmethod
    def pooled(cls, shares: Sequence[Share]) -> "Rate":
        """Return the mean of several runs' shares; for runs on the same groups their common group means count."""
        first = shares[0]
        if all(np.array_equal(first.groups, of_run.groups) for of_run in shares):
            sums, sizes = ([getattr(of_run, name) for of_run in shares] for name in ("sums", "sizes"))
            both = Share(first.groups, np.mean(sums, axis=0), np.mean(sizes, axis=0))
            return cls(both.value, both.interval(), both)
        return cls.mean([cls(share.value, share.interval()) for share in shares])

    @classmethod
    def mean(cls, rates: Sequence["Rate"]) -> "Rate":
        """Return the mean of independent shares or accuracies.

        Raises:
            UsageError: Without any.
        """
        values = [rate.value for rate in rates]
        return cls(float(np.mean(values)), mean_interval(values, [rate.interval for rate in rates]))

    def minus(self, other: "Rate") -> "Rate":
        """Return the difference, paired where both are of the same groups."""
        if self.share is not None and other.share is not None:
            gap = self.share.difference(other.share)
        else:
            gap = difference_interval(self.value, self.interval, other.value, other.interval)
        return Rate(self.value - other.value, gap)

    def paired_with(self, other: "Rate") -> bool:
        """Whether both are of the same groups."""
        if self.share is None or other.share is None:
            return False
        return np.array_equal(self.share.groups, other.share.groups)


@dataclass(frozen=True)
class PooledScores:
    """Scores of one or more runs in one category.

    Attributes:
        accuracies: Accuracies of the chosen sites, in the order of `names`.
        fit: The runs' mean on common groups, None on others.
    """

    names: tuple[str, ...]
    scores: Scores
    accuracies: tuple[Rate, ...]
    fit: CrossFit | None

    @classmethod
    def of(cls, runs: Sequence[StreamScores]) -> "PooledScores | None":
        """Return the mean over runs, of the streams that all have; None without any."""
        names = tuple(name for name in runs[0].names if all(name in run.names for run in runs)) if runs else ()
        if not names:
            return None
        fits = [_only(run, names) for run in runs]
        if not all(fit.shares_groups_with(fits[0]) for fit in fits):
            rates = tuple(map(Rate.mean, zip(*map(_rates, fits), strict=True)))
            return cls(names, Scores.mean([Scores.of(fit) for fit in fits]), rates, None)
        means = {name: np.mean([getattr(fit, name) for fit in fits], axis=0) for name in _OF_STREAMS}
        fit = replace(fits[0], **means)
        return cls(names, Scores.of(fit), _rates(fit), fit)

    def accuracy(self, name: str) -> Rate:
        """Return the accuracy of a stream's chosen site with its interval."""
        return self.accuracies[self.names.index(name)]

    def shares_groups_with(self, other: "PooledScores") -> bool:
        """Whether both are of the same groups of one suite."""
        return self.fit is not None and other.fit is not None and self.fit.shares_groups_with(other.fit)

    def covariance_with(self, other: "PooledScores") -> NDArray[np.float64]:
        """Return the covariance (K, L) of the scores; 0 on other groups.

        The covariance of a stream with itself leaves room for unseen groups, in which one run may hold all and the
        other nothing.
        """
        if self.fit is None or other.fit is None or not self.shares_groups_with(other):
            return np.zeros((len(self.names), len(other.names)))
        between = self.fit.covariance_with(other.fit)
        for name in set(self.names) & set(other.names):
            row, column = self.names.index(name), other.names.index(name)
            variances = float(self.scores.covariance[row, row]), float(other.scores.covariance[column, column])
            between[row, column] = allowing_for_unseen_groups(
                between[row, column], variances, self.fit.n_groups, CHANCE
            )
        return between

    def accuracy_difference(self, other: "PooledScores", name: str) -> Rate:
        """Return the accuracy of a stream here minus there."""
        mine, theirs = self.accuracy(name), other.accuracy(name)
        row, column = self.names.index(name), other.names.index(name)
        variances = float(self.scores.covariance[row, row]), float(other.scores.covariance[column, column])
        related = correlation_of(float(self.covariance_with(other)[row, column]), variances)
        gap = difference_interval(mine.value, mine.interval, theirs.value, theirs.interval, related)
        return Rate(mine.value - theirs.value, gap)


_OF_STREAMS = ("above", "peaks", "influence", "choice_sums", "sizes")
"""Members of `CrossFit` that have a row per stream."""


def _rates(fit: CrossFit) -> tuple[Rate, ...]:
    """Return the accuracies of all streams."""
    return tuple(Rate(CHANCE + float(above), accuracy_interval(fit, row)) for row, above in enumerate(fit.above))


def _only(run: StreamScores, names: Sequence[str]) -> CrossFit:
    rows = [run.names.index(name) for name in names]
    return replace(run.fit, **{name: getattr(run.fit, name)[rows] for name in _OF_STREAMS})


# -- retention -----------------------------------------------------------------------------------------------

NO_SCORES = "n/a (too few groups of items, or a fold with one side only)"
"""The text in place of retention where no score is defined."""
ONE_STREAM = "n/a (one stream only)"
LEAST_EXCESS = 0.05
"""Least R² above chance of a backbone; a ratio with less in the denominator is the ratio of two errors."""
STEP = "step"
"""The control that labels of several inferences need: the number of the inference alone may say as much."""
NO_STEP = "n/a (control step was not run)"


@dataclass(frozen=True)
class Peak:
    """The best site of a stream: its held-out score and family-wise p.

    Attributes:
        score: Of a side the accuracy, else the metric. It is too high by the luck of being chosen; `StreamScores`
            holds the score without it.
        ties: Number of other sites of the stream that are as accurate; `site` is the first of them all.
        chance: One half, else the mean score of the label permutations at the site; NaN without any.
    """

    site: Site
    score: float
    p_fwe: float
    ties: int = 0
    chance: float = CHANCE


@dataclass(frozen=True, kw_only=True)
class RetentionEstimate:
    """Retention of two streams.

    Attributes:
        value: Cross-fitted score of the action's best site over that of the backbone's, both above one half (see
            `probe_kit.statistics.crossfit`). NaN where the backbone's is 0, or no score is defined.
        interval: 95 %, Fieller's; without limits where the backbone is not known well enough to divide by.
        published: The ratio of the peaks, as in the paper.
        defined: Whether the backbone's best site is above chance (family-wise) and better than every control that
            was run.
        note: The missing condition where it is not defined, in few words.
        reason: Of a target that is no side, the same with the finding, the expectation and the remedy.
    """

    value: float
    interval: Interval
    published: float
    defined: bool
    note: str
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class Retention(RetentionEstimate):
    """Retention of one target in one category and view.

    Attributes:
        backbone: The best site of the backbone.
        action: The best site of the stream the action is made in.
        streams: The scores; None with too few groups of items.
    """

    backbone: Peak
    action: Peak
    streams: StreamScores | None


def best_site(curve: ProbeCurve, stream: str, iterations: Iterations = "all") -> Peak | None:
    """Return the best site of `stream`, the first one on ties; None if the curve has no such stream.

    Of a side the most accurate one counts, else the largest score above the site's own chance.

    Args:
        curve: Probes of one category in one view.
        stream: Name of the stream.
        iterations: Iterations that take part.

    Raises:
        UsageError: If the stream has no such iteration.
    """
    rows = stream_rows(curve, stream, iterations)
    if rows.size == 0:
        return None
    if curve.balanced:
        right = curve.correct[rows].sum(axis=1)
        best, ties = rows[np.argmax(right)], int((right == right.max()).sum()) - 1
    else:
        best, ties = curve.largest_excess(rows), 0
    score, p = float(curve.metric[best]), float(curve.p_fwe()[best])
    return Peak(curve.sites[best], score, p, ties, float(curve.chance[best]))


def stream_peaks(curve: ProbeCurve, iterations: Iterations = "all") -> dict[str, Peak]:
    """Return the best sites of `backbone` and of the stream the action is made in, `action`, as far as probed.

    Args:
        curve: Probes of one category in one view.
        iterations: Iterations of the action's stream that take part.

    Raises:
        UsageError: If the action's stream has no such iteration.
    """
    peaks = {}
    if curve.backbone_stream is not None:
        peaks[BACKBONE] = best_site(curve, curve.backbone_stream)
    if curve.action_stream is not None:
        peaks[ACTION] = best_site(curve, curve.action_stream, iterations)
    return {name: peak for name, peak in peaks.items() if peak is not None}


def curve_scores(curve: ProbeCurve, iterations: Iterations = "all", seed_text: str = "") -> StreamScores | None:
    """Return cross-fitted scores of the backbone and of the stream the action is made in, as far as probed.

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
    """Return the retention of `curve`, or None if it lacks the backbone or the stream the action is made in.

    Args:
        curve: Probes of one category in one view.
        iterations: Iterations of the action's stream that take part.
        seed_text: Seed text of the run; scores on equal groups of one are paired.
        exceeds: Result of `Controls.exceeds` for the backbone's best site; by default chance alone counts.

    Raises:
        UsageError: If the action's stream has no such iteration.
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
    """Return the retention of the best sites `action` and `backbone`, with the streams' scores.

    Args:
        peaks: The best sites by name.
        streams: Cross-fitted scores of both; None where no score is defined.
        exceeds: By name, whether the backbone's best site exceeds chance and each control.
        absent_below: Accuracy below which a backbone without signal counts as absent, see `verdict`.
    """
    if streams is None:
        published = _published_ratio(peaks[ACTION].score, peaks[BACKBONE].score)
        return RetentionEstimate(value=nan, interval=NO_LIMITS, published=published, defined=False, note=NO_SCORES)
    ratio: Ratio = retention(streams.scores)
    return RetentionEstimate(
        value=ratio.value,
        interval=ratio.interval,
        published=_published_ratio(streams.peak(ACTION), streams.peak(BACKBONE)),
        defined=has_signal(exceeds),
        note=_missing_signal(exceeds, streams, absent_below) if streams.at_most else "",
    )


def retention_of(
    results: ProbeResults,
    category: str,
    view: str,
    iterations: Iterations = "all",
    absent_below: float = ABSENT_BELOW,
    seed_text: str | None = None,
) -> RetentionEstimate:
    """Return the retention of a target in one category and view, without a row of a table.

    Args:
        results: Probes of the target.
        category: A probed category.
        view: A probed view.
        iterations: Iterations of the action's stream that take part.
        absent_below: Accuracy below which a backbone without signal counts as absent, see `verdict`.
        seed_text: Seed text of the run; None for that of the probes.

    Raises:
        UnknownSiteError: If category or view was not probed.
        UsageError: If the action's stream has no such iteration.
    """
    curve = probed_curve(results, category, view)
    seed_text = results.settings.seed_text if seed_text is None else seed_text
    peaks, streams = stream_peaks(curve, iterations), curve_scores(curve, iterations, seed_text)
    exceeds: Exceeds = {}
    if (best := peaks.get(BACKBONE)) is not None:
        exceeds = results.controls.exceeds(category, view, best.site, best.p_fwe)
    return estimate_of_peaks(results, category, view, peaks, exceeds, streams, absent_below)


def probed_curve(results: ProbeResults, category: str, view: str) -> ProbeCurve:
    """Return the curve of a category and view.

    Raises:
        UnknownSiteError: If category or view was not probed.
    """
    settings = results.settings
    if (category, view) not in results.curves:
        raise UnknownSiteError(
            f"category {category!r} was not probed in view {view!r}; probed: categories "
            f"{', '.join(settings.categories)} in views {', '.join(settings.views)}"
        )
    return results.curves[category, view]


def estimate_of_peaks(
    results: ProbeResults,
    category: str,
    view: str,
    peaks: Mapping[str, Peak],
    exceeds: Exceeds,
    streams: StreamScores | None,
    absent_below: float = ABSENT_BELOW,
) -> RetentionEstimate:
    """Return the retention of best sites and scores that are known already; see `retention_of`.

    Args:
        results: Probes of the target.
        category: Category of the probes.
        view: View of the probes.
        peaks: The best sites by name.
        exceeds: By name, whether the backbone's best site exceeds chance and each control; empty without one.
        streams: Cross-fitted scores of both; None where no score is defined.
        absent_below: Accuracy below which a backbone without signal counts as absent, see `verdict`.
    """
    estimate = RetentionEstimate(value=nan, interval=NO_LIMITS, published=nan, defined=False, note=ONE_STREAM)
    if len(peaks) == 2:
        estimate = estimate_retention(peaks, streams, exceeds, absent_below)
    if results.settings.balanced:
        return estimate
    above = None if streams is None or BACKBONE not in streams.names else streams.above(BACKBONE)
    note, reason = missing_condition(results, category, view, peaks, above, exceeds)
    # The paper's ratio is of accuracies above one half, which the metric of a label is not.
    return replace(estimate, published=nan, defined=not note, note=note, reason=reason)


def missing_condition(
    results: ProbeResults,
    category: str,
    view: str,
    peaks: Mapping[str, Peak],
    above: float | None,
    exceeds: Exceeds,
    tests: int = 1,
) -> tuple[str, str]:
    """Return why a label leaves nothing to retain, in few words and in full; two empty texts otherwise.

    Args:
        results: Probes of the label.
        category: Category of the probes.
        view: View of the probes.
        peaks: Best sites by name, with p corrected for `tests`.
        above: Cross-fitted score of the backbone above chance; None where no score is defined.
        exceeds: By name, whether the backbone's best site exceeds chance and each control.
        tests: Number of tests that p is corrected for.
    """
    settings = results.settings
    if len(peaks) < 2:
        part = BACKBONE if BACKBONE not in peaks else ACTION
        probed = ", ".join(results.curves[category, view].streams)
        return ONE_STREAM, (
            f"no site of the {part} was probed, so there is no retention; probed: {probed}. Extract a policy "
            "whose backbone and action stream are captured"
        )
    backbone = peaks[BACKBONE]
    best = f"the backbone's best site {backbone.site} has {METRICS[settings.task]} {backbone.score:.2f}"
    if isnan(backbone.p_fwe) or isnan(backbone.chance):
        return "n/a (no permutations)", (
            f"{best}, and no permuted labels say what chance is. Train with --permutations 200, on groups that "
            "can exchange labels"
        )
    if settings.window > 1 and STEP not in results.controls.names:
        return NO_STEP, (
            f"{best}, and labels change within episodes, so their step may say as much. Train with the control "
            f"step: `--controls {','.join([STEP, *results.controls.names])}`"
        )
    if missed := missed_controls(exceeds):
        scores = {
            control.name: control.score
            for control in results.controls.scores
            if control.category == category and control.stream in ("", backbone.site.stream)
        }
        facts = [f"chance {backbone.chance:.2f}, p {p_text(backbone.p_fwe)}"]
        facts += [f"{name} {scores[name]:.2f}" for name in missed if name in scores]
        advice = "Label more groups, or choose a label that these controls do not decode"
        if remedy := results.remedy(category, view, tests):
            advice = f"No p can be below it: {remedy}"
        return f"n/a (backbone not shown to exceed {list_names(missed)})", (
            f"{best} ({'; '.join(facts)}). Expected p < {SIGNIFICANCE} and more than every control that was run. "
            f"{advice}"
        )
    if above is None:
        return NO_SCORES, f"{best}, and too few groups to choose a site on others. Label more groups"
    if settings.task == "continuous" and above < LEAST_EXCESS:
        return f"n/a (backbone {above:.2f} above chance)", (
            f"{best}, {above:.2f} above chance where a site is chosen on other groups; expected "
            f"{LEAST_EXCESS} or more to divide by. Label more groups"
        )
    return "", ""


def _published_ratio(action: float, backbone: float) -> float:
    """Return the paper's ratio, of the best sites' accuracies above one half; NaN where the backbone's is 0."""
    return nan if backbone == CHANCE else float((action - CHANCE) / (backbone - CHANCE))


def _missing_signal(exceeds: Exceeds, streams: StreamScores, absent_below: float) -> str:
    """Return the reason why there is nothing to retain; empty where the backbone's signal is shown."""
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
    equals = [name for name, better in exceeds.items() if better is False]
    return f"n/a (backbone not shown to beat {' and '.join(equals)})" if equals else ""


def stream_rows(curve: ProbeCurve, stream: str, iterations: Iterations) -> NDArray[np.intp]:
    """Return the positions of a stream's sites at these iterations.

    Raises:
        UsageError: If the stream has no such iteration.
    """
    rows = curve.stream(stream)
    steps = {curve.sites[row].iteration for row in rows} - {None}
    if iterations in ("all", "best") or not steps:
        return rows
    step = max(filter(None, steps), default=0) if iterations == "last" else iterations
    if step not in steps:
        raise UsageError(f"the stream {stream} has iterations 0 to {len(steps) - 1}, not {step}")
    return np.array([row for row in rows if curve.sites[row].iteration == step], dtype=np.intp)


def _rows(curve: ProbeCurve, stream: str | None, iterations: Iterations = "all") -> NDArray[np.intp]:
    return np.empty(0, np.intp) if stream is None else stream_rows(curve, stream, iterations)
