"""Several runs beside each other on one scale: layer curves in the same panels, maps in a row."""

from collections.abc import Iterator, Sequence
from functools import partial
from math import ceil
from textwrap import fill
from typing import TYPE_CHECKING

from probe_kit.errors import UsageError
from probe_kit.retention.choices import Iterations
from probe_kit.retention.columns.text import title_of
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
    legend_handles,
    panels,
    plain,
    series,
    significance_handles,
)
from probe_kit.retention.displays.iteration_maps import IterationMapDisplay, draw_legend, draw_map, draw_scale
from probe_kit.retention.displays.layer_curves import draw_line
from probe_kit.retention.displays.stream_curve import LayerLine, StreamCurve
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PARTS = {"backbone": "backbone", "action": "where the action is made"}
_IN_A_ROW = 4
"""Maps side by side, of 2.4 inches each."""
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
    with_view = [(at, probes) for at, probes in enumerate(results) if view in probes.settings.views]
    panels_of = [
        (category, part)
        for category in _categories([probes for _, probes in with_view])
        if categories is None or category in categories
        for part in PARTS
        if any(_curve(probes, category, view, part, iterations) is not None for _, probes in with_view)
    ]
    if not panels_of:
        raise UsageError(f"no run has probes of a backbone or where the action is made in view {view!r}")
    figure, grid = panels(len(panels_of), width=3.6, height=2.3, columns=2, share=False)
    for (category, part), axes in zip(panels_of, grid, strict=True):
        every = [(at, _curve(probes, category, view, part, iterations)) for at, probes in with_view]
        curves = [(at, curve) for at, curve in every if curve is not None]
        _draw_panel(axes, curves, names)
        axes.set_title(f"{title_of(category)}: {PARTS[part]}", fontsize=9, loc="left")
    handles = legend_handles(*grid)
    order = {name: at for at, name in enumerate(["chance", *names])}
    legend_above(figure, [*(handles[n] for n in sorted(handles, key=order.__getitem__)), *significance_handles()])
    figure.supylabel("held-out accuracy (%)", fontsize=9)
    caption(figure, *(ProvenanceLine.of_results(probes, view) for _, probes in with_view))
    return figure


def _categories(results: Sequence[ProbeResults]) -> list[str]:
    return list(dict.fromkeys(name for probes in results for name in probes.settings.categories))


def _curve(
    results: ProbeResults, category: str, view: str, part: str, iterations: Iterations
) -> StreamCurve | None:
    scores = scores_of(results, category, view)
    scores = scores[scores["part"] == part]
    if scores.empty:
        return None
    of_stream = scores[scores["stream"] == scores["stream"].iloc[0]]
    return StreamCurve.of(of_stream, "best" if iterations == "all" else iterations)


def _draw_panel(axes: "Axes", curves: Sequence[tuple[int, StreamCurve]], names: Sequence[str]) -> None:
    """curves: with the position of their run, which decides the line's looks whatever else is shown."""
    axes.axhline(100 * CHANCE, color="0.45", lw=1, ls="--", label="chance")
    depths = {int(curve.layers.max()) for _, curve in curves}
    for rank, (at, curve) in enumerate(curves):
        line = _at_depths(curve.lines[0], curve) if len(depths) > 1 else curve.lines[0]
        step = _SIDESTEP * (rank - (len(curves) - 1) / 2) * (1 if len(depths) == 1 else 1 / max(depths))
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
    return LayerLine(line.iteration, depths, line.score, line.low, line.high, line.significant)  # type: ignore[arg-type]


def maps_side_by_side(results: Sequence[ProbeResults], names: Sequence[str], view: str) -> "Figure":
    """Layer × iteration maps of where the action is made: a row per category, a column per run, one scale.

    names: of the runs, in order. Raises UsageError if fewer than two runs have iterations in that view.
    """
    with_maps = [(name, probes) for name, probes in zip(names, results, strict=True) if has_maps(probes, view)]
    if len(with_maps) < 2:
        raise UsageError(f"fewer than two runs have iterations in view {view!r}; `iteration_maps` draws one")
    across = min(_IN_A_ROW, len(with_maps))
    rows = ceil(len(with_maps) / across)
    categories = _categories([probes for _, probes in with_maps])
    figure, grid = panels(across * rows * len(categories), width=2.7, height=2.1, columns=across, share=False)
    displays = []
    for number, category in enumerate(categories):
        panels_of = grid[number * across * rows :][: across * rows]
        for axes, at in zip(panels_of, range(across * rows), strict=True):
            if at >= len(with_maps) or category not in with_maps[at][1].settings.categories:
                axes.set_visible(False)
                continue
            name, probes = with_maps[at]
            display = IterationMapDisplay.from_results(probes, category, view)
            drawn = draw_map(axes, display)
            axes.set_title(fill(f"{title_of(category)}: {name}", _TITLE_LETTERS), fontsize=8, loc="left")
            displays.append(display)
    figure.supylabel("iteration", fontsize=9)
    draw_scale(figure, grid, drawn, displays)
    draw_legend(figure)
    caption(figure, *(ProvenanceLine.of_results(probes, view) for _, probes in with_maps))
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
    views = list(dict.fromkeys(view for results, _ in probed for view in results.settings.views))
    for view in views:
        named_results = [(results, name) for results, name in probed if view in results.settings.views]
        if len(named_results) < 2:
            continue
        of_view, called = [results for results, _ in named_results], [name for _, name in named_results]
        yield ReportFigure(
            f"curves-side-by-side{view_suffix(view, views)}", in_view("Layer curves side by side", view, views),
            "probes",
            "How often a linear probe names the side of the correct picture, layer by layer, a line per run "
            f"on one scale; of several iterations the best of every layer. {ONLY_FILLED}. "
            "The table says whether two runs differ.",
            None, partial(curves_side_by_side, of_view, called, view, source.table.iterations),
            is_detail=view != views[0],
        )  # fmt: skip
        if sum(has_maps(results, view) for results in of_view) > 1:
            yield ReportFigure(
                f"maps-side-by-side{view_suffix(view, views)}",
                in_view("Layer × iteration side by side", view, views), "probes",
                "Where and when the answer can be read while the action is made, a column per run. Colours "
                f"run from chance to 100 % in every map. {DOTS}.",
                None, partial(maps_side_by_side, of_view, called, view), is_detail=True,
            )  # fmt: skip
