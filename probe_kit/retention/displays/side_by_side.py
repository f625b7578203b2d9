"""Layer curves of several views, models or runs on one scale, and maps in a row."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil
from textwrap import fill
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.choices import Iterations
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.display import (
    Display,
    Panelled,
    curve_of,
    in_panels,
    known_view,
    of_iterations,
    scores_of,
)
from probe_kit.retention.displays.iteration_maps import IterationMapDisplay, draw_keys, draw_map
from probe_kit.retention.displays.layer_curves import LayerLine, StreamCurve, draw_line
from probe_kit.retention.displays.report_figure import (
    DOTS,
    ONLY_FILLED,
    FigureSource,
    ReportFigure,
    in_report,
    in_view,
    view_suffix,
)
from probe_kit.retention.displays.style import (
    ABOVE_CHANCE,
    ProvenanceLine,
    accuracy_axis,
    axes_for,
    caption,
    layer_axis,
    legend_above,
    legend_handles,
    panels,
    plain,
    series,
    significance_handles,
)
from probe_kit.runs.reader import full_name
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass
class RoleCurvesDisplay(Panelled):
    """Held-out accuracy by layer, one line per view of one stream, for one category.

    curves: by view, such as `mean:language`; of iterative streams, the best of the iterations at each layer.
    """

    title_size = 10
    category: str
    stream: str
    curves: dict[str, StreamCurve]
    certificate: ProvenanceLine

    @classmethod
    def from_results(
        cls,
        results: ProbeResults,
        category: str,
        stream: str = "backbone",
        views: Sequence[str] | None = None,
        iterations: Iterations = "best",
    ) -> Self:
        """Read stored probes; views: all probed ones of the stream by default. iterations: which take part.

        Raises UnknownSiteError if none of them was probed there, UnknownCategoryError for a category.
        """
        candidates = tuple(views or results.settings.views)
        curve_of(results, category, results.settings.views[0])
        curves = {}
        for view in candidates:
            scores = scores_of(results, category, view)
            rows = scores[scores["stream"] == stream]
            if not rows.empty:
                curves[view] = StreamCurve.of_stream(rows, "best" if iterations == "all" else iterations)
        if not curves:
            raise UnknownSiteError(f"none of the views {', '.join(candidates)} was probed in stream {stream!r}")
        return cls(category, stream, curves, ProvenanceLine.of_results(results, next(iter(curves))))

    @property
    def title(self) -> str:
        """The category."""
        return title_of(self.category)

    @property
    def measure(self) -> str:
        """The accuracy, and where."""
        return f"held-out accuracy (%), {label_of(self.stream)}"

    def further_handles(self) -> "Sequence[Artist]":
        """Return the handles of filled and open markers."""
        return significance_handles()

    def draw(self, axes: "Axes") -> None:
        """A line per view."""
        axes.axhline(100 * CHANCE, color="0.45", lw=1, ls=(0, (1, 1)), label="chance")
        for position, (view, curve) in enumerate(self.curves.items()):
            sidestep = 0.1 * (position - (len(self.curves) - 1) / 2)
            draw_line(axes, curve.lines[0], series(position), view, sidestep)
        accuracy_axis(axes)
        layer_axis(axes, int(max(curve.layers.max() for curve in self.curves.values())) + 1)


def role_curves(
    results: ProbeResults,
    stream: str = "backbone",
    views: Sequence[str] | None = None,
    iterations: Iterations = "best",
) -> "Figure":
    """Curves of all probed views of one stream, a panel per category. Raises UnknownSiteError without any."""
    categories = results.settings.categories
    return in_panels(
        [RoleCurvesDisplay.from_results(results, name, stream, views, iterations) for name in categories]
    )


@in_report(11)
def role_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    for drawn in source.runs:
        if drawn.results is None:
            continue
        for stream, rows in drawn.results.scores.groupby("stream", sort=False):
            if rows["view"].nunique() > 1:
                yield ReportFigure(
                    f"{drawn.stem}-roles-{stream}", f"Whose tokens carry the answer: {stream}", "probes",
                    "The same probes on the mean of one kind of token at a time.",
                    drawn.position,
                    partial(role_curves, drawn.results, str(stream), iterations=source.table.iterations),
                    is_detail=True,
                )  # fmt: skip


# -- models by depth -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ModelCurve:
    """Accuracy above chance by layer, and by depth as its fraction; (L,) each, averaged over categories."""

    model: str
    layers: NDArray[np.int64]
    depth: NDArray[np.float64]
    above_chance: NDArray[np.float64]
    categories: int


@dataclass
class ModelDepthDisplay(Display):
    """Held-out accuracy above chance against depth, averaged over categories, one line per model.

    At each layer the best of the iterations counts, in each category by itself. Lines have no markers: a mean over
    categories has no p. Layer numbers are those of the deepest model, whose length the others are stretched to.
    """

    stream: str
    models: tuple[ModelCurve, ...]
    certificates: tuple[ProvenanceLine, ...]

    @classmethod
    def from_results(
        cls,
        results: Sequence[ProbeResults],
        stream: str = "backbone",
        view: str | None = None,
        iterations: Iterations = "best",
        names: Sequence[str] | None = None,
    ) -> Self:
        """Read the stored probes of several runs; view: the first probed one of each by default.

        names: what runs are called, in order; by default as when they were probed.

        Raises UnknownSiteError for a view that was not probed, UsageError if no run has that stream, or for probes
        of a target that is no side: other metrics have no common scale.
        """
        if labels := [probes.settings.target for probes in results if not probes.settings.is_side]:
            raise UsageError(
                f"models are compared by accuracies of a side; some probes are of {labels[0]!r}. Draw their layer "
                "curves"
            )
        called = names or [full_name(probes.label, probes.settings.random_weights) for probes in results]
        every = [(probes, known_view(probes, view), name) for probes, name in zip(results, called, strict=True)]
        with_stream = [entry for entry in every if (entry[0].scores["stream"] == stream).any()]
        if not with_stream:
            raise UsageError(f"none of the {len(results)} runs has probes of stream {stream!r}")
        return cls(
            stream=stream,
            models=tuple(
                _depth_curve(probes, stream, probed_view, iterations, name)
                for probes, probed_view, name in with_stream
            ),
            certificates=tuple(
                ProvenanceLine.of_results(probes, probed_view) for probes, probed_view, _ in with_stream
            ),
        )

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and captions."""
        axes, figure = axes_for(ax, 6.2, 3.9)
        axes.axhline(0, color="0.45", lw=1, ls=(0, (1, 1)))
        last = max(int(model.layers.max()) for model in self.models)
        for position, model in enumerate(self.models):
            line = series(position)
            label = f"{model.model}, {model.layers.max() + 1} layers"
            axes.plot(
                last * model.depth, 100 * model.above_chance, color=line.colour, ls=line.dash, lw=1.6, label=label
            )
        plain(axes)
        axes.set_ylim(*ABOVE_CHANCE)
        layer_axis(axes, last + 1)
        if any(model.layers.max() < last for model in self.models):
            axes.set_xlabel("layer (of the deepest model)", fontsize=8.5)
        _draw_fractions(axes, last)
        axes.set_title(label_of(self.stream), fontsize=10, loc="left")
        if figure is not None:
            axes.set_ylabel("accuracy above chance\n(points, mean of categories)", fontsize=9)
            legend_above(figure, axes.get_legend_handles_labels()[0])
        caption(figure, *self.certificates)
        self.ax_ = axes
        return self


def model_depths(
    results: Sequence[ProbeResults],
    view: str | None = None,
    iterations: Iterations = "best",
    names: Sequence[str] | None = None,
) -> "Figure":
    """Backbones, and where actions are made, on one scale. Raises UsageError if no run has either."""
    from probe_kit.retention.displays.shown_figure import ShownFigure

    parts = {
        (str(part), str(name))
        for probes in results
        for part, name in zip(probes.scores["part"], probes.scores["stream"], strict=True)
    }
    streams = [name for part in ("backbone", "action") for part_of, name in sorted(parts) if part_of == part]
    displays = [ModelDepthDisplay.from_results(results, stream, view, iterations, names) for stream in streams]
    if not displays:
        raise UsageError("no run has probes of a backbone or an action expert")
    figure = ShownFigure(figsize=(4.1 * max(len(displays), 1.5), 3.6), layout="constrained", dpi=150)
    grid = figure.subplots(1, len(displays), sharey=True, squeeze=False)[0]
    for display, axes in zip(displays, grid, strict=True):
        display.plot(axes)
    legend_above(figure, list(legend_handles(*grid).values()))
    figure.supylabel("above chance\n(points, mean of categories)", fontsize=8)
    caption(figure, *(certificate for display in displays for certificate in display.certificates))
    return figure


def _draw_fractions(axes: "Axes", last: int) -> None:
    """Depth as a fraction along the upper side."""
    above = axes.secondary_xaxis(
        "top",
        functions=(
            lambda layer: np.asarray(layer, float) / max(1, last),
            lambda depth: np.asarray(depth, float) * last,
        ),
    )
    above.set_ticks([0, 0.25, 0.5, 0.75, 1], labels=["0", "¼", "½", "¾", "1"])
    above.set_xlabel("depth", fontsize=7.5, labelpad=5)
    above.tick_params(labelsize=7.5, pad=1)
    above.spines["top"].set_visible(False)


def _depth_curve(results: ProbeResults, stream: str, view: str, iterations: Iterations, name: str) -> ModelCurve:
    curves = []
    for category in results.settings.categories:
        scores = scores_of(results, category, view)
        scores = scores[scores["stream"] == stream]
        if not scores.empty:
            scores = of_iterations(scores, iterations)
            curves.append(scores.groupby("layer")["accuracy"].max() - scores["chance"].iloc[0])
    layers = curves[0].index.to_numpy(dtype=np.int64)
    depth = layers / max(1, layers.max())
    return ModelCurve(
        name, layers, depth, np.mean([curve.to_numpy(dtype=float) for curve in curves], axis=0), len(curves)
    )


@in_report(3)
def depth_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    results = [run.results for run in source.runs if run.results is not None]
    if len(results) > 1:
        names = [run.name for run in source.runs if run.results is not None]
        yield ReportFigure(
            "model-depths", "Models by depth", "probes",
            "How far above chance the answer can be read, against depth as a fraction, so that models with "
            "different numbers of layers can be compared.",
            None, partial(model_depths, results, iterations=source.table.iterations, names=names), is_detail=True,
        )  # fmt: skip


# -- runs ----------------------------------------------------------------------------------------------------

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
    return StreamCurve.of_stream(of_stream, "best" if iterations == "all" else iterations)


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
    for number, category in enumerate(categories):
        panels_of = grid[number * across * rows :][: across * rows]
        for axes, at in zip(panels_of, range(across * rows), strict=True):
            if at >= len(with_maps) or category not in with_maps[at][1].settings.categories:
                axes.set_visible(False)
                continue
            name, probes = with_maps[at]
            drawn = draw_map(axes, IterationMapDisplay.from_results(probes, category, view))
            axes.set_title(fill(f"{title_of(category)}: {name}", _TITLE_LETTERS), fontsize=8, loc="left")
    figure.supylabel("iteration", fontsize=9)
    draw_keys(figure, grid, drawn)
    caption(figure, *(ProvenanceLine.of_results(probes, view) for _, probes in with_maps))
    return figure


def has_maps(results: ProbeResults, view: str) -> bool:
    """Whether the action of a run is made in iterations that were probed in that view."""
    scores = results.scores
    return bool(((scores["view"] == view) & (scores["part"] == "action") & scores["iteration"].notna()).any())


@in_report(5)
def side_by_side_figures(source: FigureSource) -> Iterator[ReportFigure]:
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
