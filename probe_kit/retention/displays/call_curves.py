"""Accuracy over the captured calls of an episode, and the same counted from what happens in it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Self

from probe_kit.env.scoring.events import EVENTS
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.base.display import Display
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import (
    ONLY_FILLED,
    FigureSource,
    ReportFigure,
    in_view,
    view_suffix,
)
from probe_kit.retention.displays.base.selection import known_view
from probe_kit.retention.displays.base.style import (
    PARTS,
    accuracy_axis,
    axes_for,
    caption,
    legend_above,
    legend_handles,
    mark_below,
    panels,
    plain,
    significance_handles,
)
from probe_kit.retention.estimators.by_call import (
    AlignedLine,
    CallCurves,
    CallLine,
    EventCalls,
    EventTimes,
    event_calls,
)
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.estimates.balanced import CHANCE
from probe_kit.train.results.probe_results import ProbeResults
from probe_kit.train.results.store import load_results_by_call

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike


_PERMUTED = "best permuted probe, 95 %"


@dataclass
class CallCurveDisplay(Display):
    """Held-out accuracy of each stream's best site by captured inference, for one category in one view.

    Filled markers are above chance against all sites of their stream, and above the controls that were run; the
    dotted line is what the best site of permuted labels stays below in 95 %. Upright lines: when the events of the
    trajectories fell due, in the median, with quartiles. A site is chosen anew at each call.
    """

    category: str
    view: str
    chance: float
    lines: tuple[CallLine, ...]
    events: tuple[EventTimes, ...]
    aligned: Mapping[str, tuple[AlignedLine, ...]]
    certificate: ProvenanceLine
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_results(
        cls,
        results: Mapping[int, ProbeResults],
        category: str,
        view: str | None = None,
        events: EventCalls | None = None,
    ) -> Self:
        """Read probes by call (`load_results_by_call`). events: from `event_calls` of a run with trajectories.

        Raises UnknownSiteError for a view that was not probed, UsageError for fewer than two calls.
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
            chance=CHANCE,
            lines=tuple(map(curves.line, curves.streams)),
            events=tuple(curves.event_times()),
            aligned={event: lines for event, lines in aligned.items() if lines},
            certificate=ProvenanceLine.of_results(first, curves.view),
        )

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        axes, figure = axes_for(ax, 6.2, 3.9)
        axes.axhline(100 * self.chance, color="0.45", lw=1, ls="--", label="chance")
        for line in self.lines:
            _draw(axes, line.calls, line)
            style = PARTS[line.part]
            axes.plot(line.calls, 100 * line.null, color=style.colour, lw=0.9, ls=":", label=_PERMUTED)
            clear = line.significant
            axes.plot(
                line.calls[clear], 100 * line.accuracy[clear], color=style.colour, ls="none", marker=style.marker
            )
        for number, event in enumerate(self.events):
            _draw_event(axes, event, len(self.events) - number)
        _finish(axes, title_of(self.category), "call (captured inference, from 0)")
        if figure is not None:
            _complete(figure, axes, self.certificate, tested=True)
        self.ax_ = axes
        return self

    def plot_aligned(self, event: str, ax: "Axes | None" = None) -> Self:
        """Draw the accuracies counted from an event. Raises UsageError if too few episodes have it."""
        if event not in self.aligned:
            events = ", ".join(self.aligned) or "none"
            raise UsageError(f"too few episodes have the event {event!r}, or no trajectories; there are: {events}")
        axes, figure = axes_for(ax, 6.2, 3.9)
        axes.axhline(100 * self.chance, color="0.45", lw=1, ls="--", label="chance")
        axes.axvline(0, color="0.6", lw=0.8)
        for line in self.aligned[event]:
            _draw(axes, line.offsets, line)
        _finish(axes, f"{title_of(self.category)}: {event}", "calls after the last one before it")
        if figure is not None:
            _complete(figure, axes, self.certificate, tested=False)
        self.ax_ = axes
        return self


def call_curves(
    results: Mapping[int, ProbeResults], view: str | None = None, events: EventCalls | None = None
) -> "Figure":
    """Accuracy over captured calls for every category; arguments and errors as of `CallCurveDisplay`."""
    names = next(iter(results.values())).settings.categories
    return _figure([CallCurveDisplay.from_results(results, name, view, events) for name in names], None)


def aligned_curves(
    results: Mapping[int, ProbeResults], event: str, view: str | None = None, events: EventCalls | None = None
) -> "Figure":
    """The same counted from an event, for every category in which enough episodes have it."""
    names = next(iter(results.values())).settings.categories
    displays = [CallCurveDisplay.from_results(results, name, view, events) for name in names]
    with_event = [display for display in displays if event in display.aligned]
    if not with_event:
        raise UsageError(f"too few episodes of any category have the event {event!r}, or no trajectories")
    return _figure(with_event, event)


def _figure(displays: list[CallCurveDisplay], event: str | None) -> "Figure":
    figure, grid = panels(len(displays))
    for display, axes in zip(displays, grid, strict=True):
        if event is None:
            display.plot(axes)
        else:
            display.plot_aligned(event, axes)
    _complete(figure, grid[0], displays[0].certificate, tested=event is None)
    return figure


def _draw(axes: "Axes", places: "ArrayLike", line: CallLine | AlignedLine) -> None:
    style = PARTS[line.part]
    accuracy = 100 * line.accuracy
    if isinstance(line, CallLine):
        arms = [(accuracy - 100 * line.low).clip(min=0), (100 * line.high - accuracy).clip(min=0)]
        axes.errorbar(places, accuracy, yerr=arms, fmt="none", ecolor=style.colour, elinewidth=0.8, alpha=0.7)
    axes.plot(
        places, accuracy, color=style.colour, lw=1.3, ls=style.dash, marker=style.marker, mfc="white",
        label=label_of(line.stream),
    )  # fmt: skip
    mark_below(axes, places, accuracy, style.colour)


def _draw_event(axes: "Axes", event: EventTimes, number: int) -> None:
    """Names stand one above the other below chance, as several events may fall into one call."""
    axes.axvspan(event.low, event.high, color="0.5", alpha=0.08, lw=0)
    axes.axvline(event.median, color="0.4", lw=0.8)
    words = event.event + ("" if event.share > 0.995 else f" ({100 * event.share:.0f} %)")
    axes.annotate(
        words, (event.median, 0), (3, 8 * number - 5), xycoords=("data", "axes fraction"), fontsize=6.5,
        textcoords="offset points", color="0.3",
    )  # fmt: skip


def _finish(axes: "Axes", title: str, below: str) -> None:
    from matplotlib.ticker import MaxNLocator

    plain(axes)
    accuracy_axis(axes)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True, min_n_ticks=2))
    axes.set_title(title, fontsize=9, loc="left")
    axes.set_xlabel(below, fontsize=8.5)


def _complete(figure: "Figure", axes: "Axes", certificate: ProvenanceLine, tested: bool) -> None:
    """tested: whether markers are filled where something is evidence."""
    legend_above(figure, [*legend_handles(axes).values(), *(significance_handles() if tested else ())])
    figure.supylabel("best site, accuracy (%)", fontsize=9)
    caption(figure, replace(certificate, call=None))


PLACE = 12
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    for drawn in source.runs:
        if drawn.results is not None:
            yield from _of_run(drawn.stem, drawn.position, drawn.run, drawn.results)


def _of_run(name: str, position: int, run: RunReader, results: ProbeResults) -> Iterator[ReportFigure]:
    """Only where a later inference was probed as well."""
    calls = load_results_by_call(run, results)
    if len(calls) < 2:
        return
    views, events = results.settings.views, event_calls(run)
    for view in views:
        yield ReportFigure(
            f"{name}-calls{view_suffix(view, views)}", in_view("Over the episode", view, views), "probes",
            f"The best site of each part at every inference that was captured, counted from 0. {ONLY_FILLED}; "
            "dotted: what the best site of permuted labels stays below. An answer that is not there at "
            "call 0 may not be needed yet: upright lines say when the arm set off, grasped, chose a side, let go.",
            position, partial(call_curves, calls, view, events), is_detail=view != views[0],
        )  # fmt: skip
    curves = [CallCurves.of(calls, category, views[0], events) for category in results.settings.categories]
    for event in EVENTS:
        if any(curve.aligned(stream, event) is not None for curve in curves for stream in curve.streams):
            yield ReportFigure(
                f"{name}-calls-{event.replace(' ', '-')}", f"Around an event: {event}", "probes",
                "The same, with every episode's inferences counted from its own event: 0 is the last one "
                "before it.",
                position, partial(aligned_curves, calls, event, views[0], events), is_detail=True,
            )  # fmt: skip
