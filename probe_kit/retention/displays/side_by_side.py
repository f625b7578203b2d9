"""Several runs beside each other on one scale: layer curves in the same panels, maps in a row."""

from collections.abc import Iterator, Sequence
from functools import partial
from math import ceil
from textwrap import fill
from typing import TYPE_CHECKING

from probe_kit.errors import UsageError
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import (
    DOTS,
    ONLY_FILLED,
    FigureSource,
    ReportFigure,
    in_view,
    view_suffix,
)
from probe_kit.retention.displays.base.selection import scores_of
from probe_kit.retention.displays.base.style import (
    accuracy_axis,
    caption,
    layer_axis,
    legend_above,
    panels,
    plain,
    series,
    significance_handles,
)
from probe_kit.retention.displays.iteration_maps import IterationMapDisplay, draw_legend, draw_map, draw_scale
from probe_kit.retention.displays.layer_curves import draw_line
from probe_kit.retention.displays.stream_curve import LayerLine, StreamCurve
from probe_kit.retention.estimators.retention import Iterations
from probe_kit.retention.text import spell
from probe_kit.statistics.estimates.balanced import CHANCE
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PARTS = {"backbone": "backbone", "action": "where the action is made"}
_IN_A_ROW = 4
_TITLE_LETTERS = 36
"""Letters of a line above a map, which is 2.4 inches wide."""
_SIDESTEP = 0.08  # of a layer, so that bars do not hide each other


def curves_side_by_side(
    results: Sequence[ProbeResults],
    names: Sequence[str],
    view: str,
    iterations: Iterations = "best",
    categories: Sequence[str] | None = None,
) -> "Figure":
    """Layer curves of several runs: a panel per category and part of the model, a line per run.

    Of iterative streams the best of the iterations at each layer counts. Lines have no intervals: the table says
    whether two runs differ. Along the lower side layers, or depth as a fraction where runs differ in their
    number. names: of the runs, in order. view: one that some of them were probed in. categories: that are shown,
    all by default. Raises UsageError if none was.
    """
    known = [(at, one) for at, one in enumerate(results) if view in one.settings.views]
    panels_of = [
        (category, part)
        for category in _categories([one for _, one in known])
        if categories is None or category in categories
        for part in PARTS
        if any(_curve(one, category, view, part, iterations) is not None for _, one in known)
    ]
    if not panels_of:
        raise UsageError(f"no run has probes of a backbone or where the action is made in view {view!r}")
    figure, grid = panels(len(panels_of), width=3.6, height=2.3, columns=2, share=False)
    for (category, part), axes in zip(panels_of, grid, strict=True):
        found = [(at, _curve(one, category, view, part, iterations)) for at, one in known]
        curves = [(at, curve) for at, curve in found if curve is not None]
        _draw_panel(axes, curves, names)
        axes.set_title(f"{spell(category)}: {PARTS[part]}", fontsize=9, loc="left")
    handles: dict[str, Artist] = {}
    for axes in grid:
        handles |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    order = {name: at for at, name in enumerate(["chance", *names])}
    legend_above(figure, [*(handles[n] for n in sorted(handles, key=order.__getitem__)), *significance_handles()])
    figure.supylabel("held-out accuracy (%)", fontsize=9)
    caption(figure, *(ProvenanceLine.of_results(one, view) for _, one in known))
    return figure


def _categories(results: Sequence[ProbeResults]) -> list[str]:
    return list(dict.fromkeys(name for one in results for name in one.settings.categories))


def _curve(
    results: ProbeResults, category: str, view: str, part: str, iterations: Iterations
) -> StreamCurve | None:
    scores = scores_of(results, category, view)
    scores = scores[scores["part"] == part]
    if scores.empty:
        return None
    own = scores[scores["stream"] == scores["stream"].iloc[0]]
    return StreamCurve.of(own, "best" if iterations == "all" else iterations)


def _draw_panel(axes: "Axes", curves: Sequence[tuple[int, StreamCurve]], names: Sequence[str]) -> None:
    """curves: with the position of their run, which decides the line's looks whatever else is shown."""
    axes.axhline(100 * CHANCE, color="0.45", lw=1, ls="--", label="chance")
    depths = {int(curve.layers.max()) for _, curve in curves}
    for place, (at, curve) in enumerate(curves):
        line = _at_depths(curve.lines[0], curve) if len(depths) > 1 else curve.lines[0]
        step = _SIDESTEP * (place - (len(curves) - 1) / 2) * (1 if len(depths) == 1 else 1 / max(depths))
        draw_line(axes, line, series(at), names[at], step, bars=False)
    plain(axes)
    accuracy_axis(axes)
    if len(depths) > 1:
        axes.set_xlim(-0.04, 1.04)
        axes.set_xlabel("depth", fontsize=8.5)
    else:
        layer_axis(axes, max(depths) + 1)


def _at_depths(line: LayerLine, curve: StreamCurve) -> LayerLine:
    """The line along depth as a fraction."""
    depths = curve.depth
    return LayerLine(line.iteration, depths, line.accuracy, line.low, line.high, line.significant)  # type: ignore[arg-type]


def maps_side_by_side(results: Sequence[ProbeResults], names: Sequence[str], view: str) -> "Figure":
    """Layer × iteration maps of where the action is made: a row per category, a column per run, one scale.

    names: of the runs, in order. Raises UsageError if fewer than two runs have iterations in that view.
    """
    shown = [(name, one) for name, one in zip(names, results, strict=True) if has_maps(one, view)]
    if len(shown) < 2:
        raise UsageError(f"fewer than two runs have iterations in view {view!r}; `iteration_maps` draws one")
    across = min(_IN_A_ROW, len(shown))
    rows = ceil(len(shown) / across)
    categories = _categories([one for _, one in shown])
    figure, grid = panels(across * rows * len(categories), width=2.7, height=2.1, columns=across, share=False)
    displays = []
    for number, category in enumerate(categories):
        own = grid[number * across * rows :][: across * rows]
        for axes, place in zip(own, range(across * rows), strict=True):
            if place >= len(shown) or category not in shown[place][1].settings.categories:
                axes.set_visible(False)
                continue
            name, one = shown[place]
            display = IterationMapDisplay.from_results(one, category, view)
            drawn = draw_map(axes, display)
            axes.set_title(fill(f"{spell(category)}: {name}", _TITLE_LETTERS), fontsize=8, loc="left")
            displays.append(display)
    figure.supylabel("iteration", fontsize=9)
    draw_scale(figure, grid, drawn, displays)
    draw_legend(figure)
    caption(figure, *(ProvenanceLine.of_results(one, view) for _, one in shown))
    return figure


def has_maps(results: ProbeResults, view: str) -> bool:
    """Whether the action of a run is made in iterations that were probed in that view."""
    scores = results.scores
    return bool(((scores["view"] == view) & (scores["part"] == "action") & scores["iteration"].notna()).any())


PLACE = 5
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    probed = [(run.results, run.name) for run in source.runs if run.results is not None]
    views = list(dict.fromkeys(view for one, _ in probed for view in one.settings.views))
    for view in views:
        own = [(one, name) for one, name in probed if view in one.settings.views]
        if len(own) < 2:
            continue
        known, called = [one for one, _ in own], [name for _, name in own]
        yield ReportFigure(
            f"curves-side-by-side{view_suffix(view, views)}", in_view("Layer curves side by side", view, views),
            "probes",
            "How often a linear probe names the side of the correct picture, layer by layer, a line per run "
            f"on one scale; of several iterations the best of every layer. {ONLY_FILLED}. "
            "The table says whether two runs differ.",
            None, partial(curves_side_by_side, known, called, view, source.table.iterations),
            is_detail=view != views[0],
        )  # fmt: skip
        if sum(has_maps(one, view) for one in known) > 1:
            yield ReportFigure(
                f"maps-side-by-side{view_suffix(view, views)}",
                in_view("Layer × iteration side by side", view, views), "probes",
                "Where and when the answer can be read while the action is made, a column per run. Colours "
                f"run from chance to 100 % in every map. {DOTS}.",
                None, partial(maps_side_by_side, known, called, view), is_detail=True,
            )  # fmt: skip
