"""Accuracy over the captured calls of an episode, also counted from the events in it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit.env.scoring import EVENTS, Events
from probe_kit.errors import TooFewGroupsError, UsageError
from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.display import (
    PARTS,
    Display,
    ProvenanceLine,
    accuracy_axis,
    draw_intervals,
    in_panels,
    known_view,
    mark_below,
    significance_handles,
)
from probe_kit.retention.displays.report_figure import (
    ONLY_FILLED,
    DrawnRun,
    FigureSource,
    ReportFigure,
    in_report,
    in_view,
    view_suffix,
)
from probe_kit.retention.estimators import best_site, score_streams
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.statistics.sufficiency import FEWEST_PERMUTATIONS
from probe_kit.train.results.control_scores import has_signal
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import load_results_by_call

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike


EventCalls = Mapping[str, Mapping[str, int]]
"""By event and episode id, the captured inference before it."""


@dataclass(frozen=True)
class CallLine:
    """Held-out accuracy of a stream's best site by captured inference; arrays (C,), accuracies as shares.

    Attributes:
        part: Part of the model, see `Stream.part`.
        calls: The captured inferences, counted from 0.
        accuracy: Accuracy on the outer folds of the sites that the inner folds choose.
        low: Lower end of its 95 % interval, NaN with too few groups.
        high: Upper end of the interval.
        significant: Above chance against all sites of the stream, and above the controls that were run.
        null: The accuracy that the best site of permuted labels stays below in 95 %, NaN with few label
            permutations.
        episodes: Number of episodes that reached the inference.
    """

    stream: str
    part: str
    calls: NDArray[np.int64]
    accuracy: Matrix
    low: Matrix
    high: Matrix
    significant: NDArray[np.bool_]
    null: Matrix
    episodes: NDArray[np.int64]


@dataclass(frozen=True)
class AlignedLine:
    """Held-out accuracy of a stream's best sites, counted from an event of each episode.

    Offset 0 is the last inference before the action that brought the event about. Sites are those that the inner
    folds of every call choose. There is no interval.

    Attributes:
        offsets: (O,) offsets with at least `FEWEST` episodes.
    """

    stream: str
    part: str
    offsets: NDArray[np.int64]
    accuracy: Matrix
    episodes: NDArray[np.int64]


@dataclass(frozen=True)
class EventTimes:
    """The captured inference at which an event fell due: median and quartiles over the episodes that have it.

    Attributes:
        share: Share of all episodes that have the event.
    """

    event: str
    median: float
    low: float
    high: float
    share: float


FEWEST = 10
"""Number of episodes from which on an accuracy is shown."""


@dataclass(frozen=True)
class CallCurves:
    """One category in one view over the captured inferences of a run.

    Attributes:
        results: The probes by call.
        events: The inferences before the events, from `event_calls`; empty without trajectories.
    """

    results: Mapping[int, ProbeResults]
    category: str
    view: str
    events: EventCalls

    @classmethod
    def of(
        cls, results: Mapping[int, ProbeResults], category: str, view: str, events: EventCalls | None = None
    ) -> Self:
        """Read probes by call.

        Args:
            results: Probe results by call, from `load_results_by_call`.
            category: A category that was probed at every call.
            view: A view that was probed at every call.
            events: The inferences before the events, from `event_calls`; None for no events.

        Raises:
            UsageError: For probes of a single call, or without that category and view.
        """
        if len(results) < 2:
            raise UsageError(
                f"probes of call {', '.join(map(str, results))} make no curve over calls; extract with "
                "--captured-calls N and fit them with `probe-kit train --call all`"
            )
        if lacking := [call for call, probes in results.items() if (category, view) not in probes.curves]:
            raise UsageError(f"call {lacking[0]} has no probes of category {category!r} in view {view!r}")
        return cls(results, category, view, events or {})

    @property
    def streams(self) -> tuple[str, ...]:
        """The streams that were probed at every call, in order."""
        curves = list(self._curves.values())
        first = dict.fromkeys(site.stream for site in curves[0].sites)
        return tuple(name for name in first if all(curve.stream(name).size for curve in curves))

    def line(self, stream: str) -> CallLine:
        """Return the accuracy of the stream's best site at each call."""
        points = [self._point(call, curve, stream) for call, curve in self._curves.items()]
        accuracy, low, high, significant, null, episodes = map(np.array, zip(*points, strict=True))
        calls = np.array(list(self._curves), np.int64)
        return CallLine(stream, self._part(stream), calls, accuracy, low, high, significant, null, episodes)

    def aligned(self, stream: str, event: str) -> AlignedLine | None:
        """Return the stream's best sites counted from an event; None where too few episodes have it."""
        pools: dict[int, list[bool]] = {}
        for call, curve in self._curves.items():
            right = curve.nested_correct(curve.stream(stream))
            for episode, hit in zip(curve.episodes, right, strict=True):
                due = self.events.get(event, {}).get(str(episode))
                if due is not None:
                    pools.setdefault(call - due, []).append(bool(hit))
        large = {offset: pools[offset] for offset in sorted(pools) if len(pools[offset]) >= FEWEST}
        if not large:
            return None
        accuracy = np.array([np.mean(pool) for pool in large.values()])
        sizes = np.array([len(pool) for pool in large.values()], np.int64)
        offsets = np.array(list(large), np.int64)
        return AlignedLine(stream, self._part(stream), offsets, accuracy, sizes)

    def event_times(self) -> list[EventTimes]:
        """Return when the events of this category's episodes fell due; those that no episode has are left out."""
        episodes = self._curves[min(self._curves)].episodes
        times = []
        for event, calls in self.events.items():
            due = [calls[str(episode)] for episode in episodes if str(episode) in calls]
            if due:
                low, median, high = np.percentile(due, [25, 50, 75])
                times.append(EventTimes(event, float(median), float(low), float(high), len(due) / len(episodes)))
        return times

    @property
    def _curves(self) -> dict[int, ProbeCurve]:
        return {call: probes.curves[self.category, self.view] for call, probes in self.results.items()}

    def _part(self, stream: str) -> str:
        curve = next(iter(self._curves.values()))
        return curve.parts[int(curve.stream(stream)[0])]

    def _point(self, call: int, curve: ProbeCurve, stream: str) -> tuple[float, float, float, bool, float, int]:
        rows, peak = curve.stream(stream), best_site(curve, stream)
        assert peak is not None, "the stream was probed at every call"
        exceeds = self.results[call].controls.exceeds(self.category, self.view, str(peak.site), peak.p_fwe)
        nulls = curve.null[rows]
        null = np.percentile(nulls.max(axis=0), 95) if nulls.shape[1] >= FEWEST_PERMUTATIONS else np.nan
        seed_text = next(iter(self.results.values())).settings.seed_text
        try:
            scores = score_streams(curve, {stream: rows}, seed_text)
        except TooFewGroupsError:
            accuracy, low, high = float(curve.sums.only(rows).accuracies.max()), np.nan, np.nan
        else:
            assert scores is not None, "one stream was given"
            interval = scores.interval(stream)
            accuracy, low, high = scores.accuracy(stream), interval.low, interval.high
        return accuracy, low, high, has_signal(exceeds), float(null), curve.labels.size


def event_calls(run: Any) -> EventCalls:
    """Return by event and episode id the last inference before the action that brought the event about.

    Empty for a run without trajectories. Inference c decides actions c · k + 1 to (c + 1) · k, with k actions
    executed per inference.
    """
    if not run.has_trajectories:
        return {}
    executed = int(run.settings["execute"])
    by_event: dict[str, dict[str, int]] = {event: {} for event in EVENTS}
    for episode, trajectory in zip(run.episodes["episode_id"], run.trajectories, strict=True):
        events = Events.of(trajectory)
        for event in EVENTS:
            frame = events.frame(event)
            if frame is not None and frame > 0:
                by_event[event][str(episode)] = (frame - 1) // executed
    return by_event


# -- figures -------------------------------------------------------------------------------------------------

_PERMUTED = "best permuted probe, 95 %"


@dataclass(kw_only=True)
class CallCurveDisplay(Display):
    """Held-out accuracy of each stream's best site by captured inference, for one category in one view.

    Filled markers are above chance against all sites of their stream, and above the controls that were run. The
    best site of permuted labels stays below the dotted line in 95 %. Upright lines: when the events of the
    trajectories fell due, in the median, with quartiles. A site is chosen anew at each call.

    Attributes:
        event: The event from which accuracies are counted instead, see `plot_aligned`.
    """

    category: str
    view: str
    lines: tuple[CallLine, ...]
    events: tuple[EventTimes, ...]
    aligned: Mapping[str, tuple[AlignedLine, ...]]
    event: str | None = None

    @classmethod
    def from_results(
        cls,
        results: Mapping[int, ProbeResults],
        category: str,
        view: str | None = None,
        events: EventCalls | None = None,
    ) -> Self:
        """Read probes by call.

        Args:
            results: Probe results by call, from `load_results_by_call`.
            category: The category that is drawn.
            view: A probed view; None for the first.
            events: Events of a run with trajectories, from `event_calls`.

        Raises:
            UnknownSiteError: For a view that was not probed.
            UsageError: For fewer than two calls.
        """
        first = next(iter(results.values()))
        curves = CallCurves.of(results, category, known_view(first, view), events)
        aligned = {
            event: tuple(line for name in curves.streams if (line := curves.aligned(name, event)) is not None)
            for event in EVENTS
        }
        return cls(
            category=category,
            view=curves.view,
            lines=tuple(map(curves.line, curves.streams)),
            events=tuple(curves.event_times()),
            aligned={event: lines for event, lines in aligned.items() if lines},
            title=title_of(category),
            measure="best site, accuracy (%)",
            certificates=(replace(ProvenanceLine.of_results(first, curves.view), call=None),),
        )

    def plot_aligned(self, event: str, ax: "Axes | None" = None) -> Self:
        """Draw the accuracies counted from an event.

        Args:
            event: The event at offset 0.
            ax: Axes to draw on; None makes a figure.

        Raises:
            UsageError: If too few episodes have it.
        """
        if event not in self.aligned:
            events = ", ".join(self.aligned) or "none"
            raise UsageError(f"too few episodes have the event {event!r}, or no trajectories; there are: {events}")
        return self.around(event).plot(ax)

    def around(self, event: str) -> Self:
        """Return the display that counts from an event."""
        return replace(self, event=event, title=f"{title_of(self.category)}: {event}")

    def further_handles(self) -> "Sequence[Artist]":
        """Return the handles of filled and open markers; around an event nothing is tested."""
        return [] if self.event else significance_handles()

    def draw(self, axes: "Axes") -> None:
        """Draw the streams by call, with the events, or around an event."""
        from matplotlib.ticker import MaxNLocator

        axes.axhline(100 * CHANCE, color="0.45", lw=1, ls="--", label="chance")
        if self.event is None:
            self._draw_calls(axes)
        else:
            axes.axvline(0, color="0.6", lw=0.8)
            for line in self.aligned[self.event]:
                _draw(axes, line.offsets, line)
        accuracy_axis(axes)
        axes.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True, min_n_ticks=2))
        below = "calls after the last one before it" if self.event else "call (captured inference, from 0)"
        axes.set_xlabel(below, fontsize=8.5)

    def _draw_calls(self, axes: "Axes") -> None:
        for line in self.lines:
            style, clear, accuracy = PARTS[line.part], line.significant, 100 * line.accuracy
            draw_intervals(axes, line.calls, accuracy, style.colour, [100 * line.low, 100 * line.high])
            _draw(axes, line.calls, line)
            axes.plot(line.calls, 100 * line.null, color=style.colour, lw=0.9, ls=":", label=_PERMUTED)
            axes.plot(line.calls[clear], accuracy[clear], color=style.colour, ls="none", marker=style.marker)
        for number, event in enumerate(self.events):
            # Names stand one above the other below chance, as several events may fall into one call.
            height = 8 * (len(self.events) - number) - 5
            axes.axvspan(event.low, event.high, color="0.5", alpha=0.08, lw=0)
            axes.axvline(event.median, color="0.4", lw=0.8)
            words = event.event + ("" if event.share > 0.995 else f" ({100 * event.share:.0f} %)")
            axes.annotate(
                words, (event.median, 0), (3, height), xycoords=("data", "axes fraction"), fontsize=6.5,
                textcoords="offset points", color="0.3",
            )  # fmt: skip


def _draw(axes: "Axes", places: "ArrayLike", line: CallLine | AlignedLine) -> None:
    style, accuracy = PARTS[line.part], 100 * line.accuracy
    axes.plot(
        places, accuracy, color=style.colour, lw=1.3, ls=style.dash, marker=style.marker, mfc="white",
        label=label_of(line.stream),
    )  # fmt: skip
    mark_below(axes, places, accuracy, style.colour)


def call_curves(
    results: Mapping[int, ProbeResults], view: str | None = None, events: EventCalls | None = None
) -> "Figure":
    """Return a figure of accuracy over captured calls, a panel per category.

    Arguments and errors are those of `CallCurveDisplay.from_results`.
    """
    names = next(iter(results.values())).settings.categories
    return in_panels([CallCurveDisplay.from_results(results, name, view, events) for name in names])


def aligned_curves(
    results: Mapping[int, ProbeResults], event: str, view: str | None = None, events: EventCalls | None = None
) -> "Figure":
    """Return a figure of accuracies counted from an event, for every category in which enough episodes have it."""
    names = next(iter(results.values())).settings.categories
    displays = [CallCurveDisplay.from_results(results, name, view, events) for name in names]
    with_event = [display.around(event) for display in displays if event in display.aligned]
    if not with_event:
        raise UsageError(f"too few episodes of any category have the event {event!r}, or no trajectories")
    return in_panels(with_event)


@in_report(12)
def call_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield a figure per run whose later inferences were probed as well."""
    for drawn in source.runs:
        # Only where a later inference was probed as well.
        if drawn.results is not None and len(calls := load_results_by_call(drawn.run, drawn.results)) > 1:
            yield from _run_figures(drawn, drawn.results, calls)


def _run_figures(
    drawn: DrawnRun, results: ProbeResults, calls: Mapping[int, ProbeResults]
) -> Iterator[ReportFigure]:
    views, events = results.settings.views, event_calls(drawn.run)
    for view in views:
        yield ReportFigure(
            f"{drawn.stem}-calls{view_suffix(view, views)}", in_view("Over the episode", view, views), "probes",
            f"The best site of each part at every inference that was captured, counted from 0. {ONLY_FILLED}; "
            "dotted: what the best site of permuted labels stays below. An answer that is not there at "
            "call 0 may not be needed yet: upright lines say when the arm set off, grasped, chose a side, let go.",
            drawn.position, partial(call_curves, calls, view, events), is_detail=view != views[0],
        )  # fmt: skip
    curves = [CallCurves.of(calls, category, views[0], events) for category in results.settings.categories]
    for event in EVENTS:
        if any(curve.aligned(stream, event) is not None for curve in curves for stream in curve.streams):
            yield ReportFigure(
                f"{drawn.stem}-calls-{event.replace(' ', '-')}", f"Around an event: {event}", "probes",
                "The same, with every episode's inferences counted from its own event: 0 is the last one "
                "before it.",
                drawn.position, partial(aligned_curves, calls, event, views[0], events), is_detail=True,
            )  # fmt: skip
