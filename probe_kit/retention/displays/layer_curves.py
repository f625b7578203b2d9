"""Layer curves: score by layer, the backbone beside where the action is made, a line per iteration."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil
from typing import TYPE_CHECKING, Literal, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.choices import Iterations
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.display import Display, known_view, of_iterations, probed_curve, scores_of
from probe_kit.retention.displays.report_figure import (
    ONLY_FILLED,
    FigureSource,
    ReportFigure,
    in_report,
    in_view,
    label_views,
    view_suffix,
)
from probe_kit.retention.displays.style import (
    DPI,
    PARTS,
    Line,
    ProvenanceLine,
    accuracy_axis,
    caption,
    layer_axis,
    legend_above,
    legend_handles,
    mark_below,
    plain,
    significance_handles,
)
from probe_kit.statistics.sufficiency import FEWEST_PERMUTATIONS
from probe_kit.train.choices import EVERYWHERE, SIDES
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D


Shares = NDArray[np.float64]


@dataclass(frozen=True)
class LayerLine:
    """Held-out score by layer; arrays (L,), accuracies as shares or R², with their 95 % interval over groups.

    iteration: of all values, None where the stream runs once or where every layer has its best one.
    significant: above chance, family-wise, and above the controls that were run.
    """

    iteration: int | None
    layers: NDArray[np.int64]
    score: Shares
    low: Shares
    high: Shares
    significant: NDArray[np.bool_]

    @classmethod
    def of(cls, rows: "pd.DataFrame", iteration: int | None = None) -> Self:
        """Read rows of `ProbeResults.scores`, one per layer."""
        rows = rows.sort_values("layer")
        score, low, high = (rows[name].to_numpy(dtype=float) for name in ("score", "ci_low", "ci_high"))
        significant = rows["signal"].to_numpy(dtype=bool)
        return cls(iteration, rows["layer"].to_numpy(dtype=np.int64), score, low, high, significant)


@dataclass(frozen=True)
class StreamCurve(LayerLine):
    """One stream's held-out score by layer; arrays (L,), accuracies as shares or R².

    part: of the model, see `Stream.part`. depth: the layer as a fraction.

    sites: L best ones of the iterations that are shown, of a label by the score above their own chance. score: of
    these. iterations: how many are shown.
    lines: what is drawn: one per iteration, or the best. peaks: (layer, iteration) of the best sites, all of them
    where several tie.
    """

    stream: str
    part: str
    sites: tuple[str, ...]
    depth: Shares
    iterations: int
    lines: tuple[LayerLine, ...]
    peaks: tuple[tuple[int, int | None], ...]

    @classmethod
    def of_stream(cls, scores: "pd.DataFrame", iterations: Iterations = "best") -> Self:
        """Read the rows of one category, view and stream of `ProbeResults.scores`.

        Raises UsageError if the stream has no such iteration.
        """
        scores = of_iterations(scores, iterations)
        excess = scores["score"] - (0.0 if scores["target"].iloc[0] in SIDES else scores["chance"].fillna(0.0))
        best_rows = scores.loc[excess.groupby(scores["layer"]).idxmax()].sort_values("layer")
        best = LayerLine.of(best_rows)
        steps = sorted(int(step) for step in scores["iteration"].dropna().unique())
        each = tuple(LayerLine.of(scores[scores["iteration"] == step], step) for step in steps)
        tied = scores[excess >= excess.max() - 1e-12]  # equal but for rounding of sums
        return cls(
            stream=str(scores["stream"].iloc[0]),
            part=str(scores["part"].iloc[0]),
            sites=tuple(best_rows["site"]),
            **vars(best),
            depth=best_rows["depth"].to_numpy(dtype=float),
            iterations=len(steps) or 1,
            lines=each if each and iterations != "best" else (best,),
            peaks=tuple(
                (int(layer), None if np.isnan(step) else int(step))
                for layer, step in zip(tied["layer"], tied["iteration"].astype("float64"), strict=True)
            ),
        )

    @property
    def name(self) -> str:
        """Return the name that people call the stream."""
        return label_of(self.stream)

    @property
    def label(self) -> str:
        """The name, and which iterations are shown if not all are."""
        if self.iterations > 1:
            return f"{self.name}, best iteration" if len(self.lines) == 1 else self.name
        step = self.lines[0].iteration
        return self.name if step is None else f"{self.name}, iteration {step}"


_SIDESTEP = 0.1  # of a layer, so that the bars of two streams on one axes do not hide each other

_PEAK = "best of its stream (all, where several tie)"
PERCENT = 100.0


@dataclass(frozen=True)
class Ground:
    """The chance, band and control that the scores of one stream are compared with; arrays (L,) by layer.

    chance: one half for a side, else the mean score of the label permutations at the layer's best site; NaN
    without any. null_band: ends of the range that holds 95 % of the scores under label permutation, of a side
    those of all sites; None below 20 permutations. control: name and score of the best control of a label.
    """

    chance: NDArray[np.float64]
    null_band: tuple[NDArray[np.float64], NDArray[np.float64]] | None
    control: tuple[str, float] | None = None

    @classmethod
    def of(cls, results: ProbeResults, category: str, view: str, stream: StreamCurve) -> Self:
        """Return the ground of a stream's best sites."""
        curve = results.curves[category, view]
        names = [str(site) for site in curve.sites]
        rows = [names.index(site) for site in stream.sites]
        every = np.broadcast_to(curve.null.ravel(), (len(rows), curve.null.size))
        # All sites of a side have chance one half, so that one band serves them; a label's chance differs by site.
        null = every if curve.is_side else curve.null[rows]
        ends = np.percentile(null, [2.5, 97.5], axis=1) if curve.null.shape[1] >= FEWEST_PERMUTATIONS else None
        controls = () if curve.is_side else results.controls.of_stream(category, view, stream.stream)
        return cls(
            curve.chance[rows],
            None if ends is None else (ends[0], ends[1]),
            (controls[0].name, controls[0].score) if controls else None,
        )

    def draw(self, axes: "Axes", layers: NDArray[np.int64], scale: float) -> None:
        """Draw the band, chance and the best control; scale: 100 for percent."""
        wide = layers if layers.size > 1 else layers + np.array([-0.3, 0.3])
        if self.null_band is not None:
            low, high = (scale * np.broadcast_to(end, wide.shape) for end in self.null_band)
            name = "95 % of probes of permuted labels"
            if np.ptp(low) == np.ptp(high) == 0:
                axes.axhspan(low[0], high[0], color="0.92", lw=0, label=name)
            else:
                axes.fill_between(wide, low, high, color="0.92", lw=0, label=name)
        chance = scale * np.broadcast_to(self.chance, wide.shape)
        if np.ptp(chance) == 0:
            axes.axhline(chance[0], color="0.45", lw=1, ls="--", label="chance")
        elif not np.isnan(chance).any():
            axes.plot(wide, chance, color="0.45", lw=1, ls="--", label="chance")
        if self.control is not None:
            name, score = self.control
            axes.axhline(scale * score, color="black", lw=1, ls=":", label="best control")
            axes.annotate(
                f"control {name} {score:.2f}", (0.01, scale * score), xycoords=axes.get_yaxis_transform(),
                ha="left", va="bottom", fontsize=6.5, color="0.2",
            )  # fmt: skip


@dataclass
class LayerCurveDisplay(Display):
    """Held-out score by layer, for one category in one view: accuracy of a side, metric of a label.

    Filled markers are above chance against the best site of their stream (family-wise p < 0.05), and above every
    control that was run. grounds: what the scores are compared with, one per stream.
    """

    target: str
    metric: str
    category: str
    view: str
    streams: tuple[StreamCurve, ...]
    grounds: tuple[Ground, ...]
    certificate: ProvenanceLine

    @classmethod
    def from_results(
        cls,
        results: ProbeResults,
        category: str | None = None,
        view: str | None = None,
        iterations: Iterations = "all",
    ) -> Self:
        """Read stored probes; category, view: the first probed one by default.

        iterations: a line for each of `all`, for the `best` of every layer, for the `last` one or one by number.
        Raises UnknownSiteError for a view, and UnknownCategoryError for a category, that was not probed, and
        UsageError for an iteration that no stream has.
        """
        category, view, _ = probed_curve(results, view, category)
        scores, settings = scores_of(results, category, view), results.settings
        streams = tuple(
            StreamCurve.of_stream(rows, iterations) for _, rows in scores.groupby("stream", sort=False)
        )
        return cls(
            target=settings.target,
            metric=METRICS[settings.task],
            category=category,
            view=view,
            streams=streams,
            grounds=tuple(Ground.of(results, category, view, stream) for stream in streams),
            certificate=ProvenanceLine.of_results(results, view, None if settings.is_side else category),
        )

    @property
    def is_side(self) -> bool:
        """Whether the target is a side, whose accuracies are drawn in percent on one scale."""
        return self.target in SIDES

    @property
    def name(self) -> str:
        """The category of a side, or the label."""
        if self.is_side:
            return title_of(self.category)
        return self.target if self.category == EVERYWHERE else f"{self.target}, {title_of(self.category)}"

    @property
    def measure(self) -> str:
        """The name of the upright axis."""
        return "held-out accuracy (%)" if self.is_side else f"held-out {self.metric}"

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw all streams on `ax`, or each beside the other on a figure of its own with legend and caption."""
        if ax is not None:
            for number, curve in enumerate(self.streams):
                if number == 0:
                    self.grounds[0].draw(ax, curve.layers, self._scale)
                _draw_stream(ax, curve, _SIDESTEP * (number - (len(self.streams) - 1) / 2), self._scale)
            self._finish(ax, max(curve.layers.max() for curve in self.streams) + 1, self.name)
            self.ax_ = ax
            return self
        figure, grid = _pairs([self], in_pyplot=True)
        self.ax_ = grid[0][0]
        _complete(figure, grid, [self])
        return self

    def plot_beside(self, axes: "Sequence[Axes]") -> Self:
        """Draw each stream on axes of its own."""
        for curve, ground, ax in zip(self.streams, self.grounds, axes, strict=False):
            ground.draw(ax, curve.layers, self._scale)
            _draw_stream(ax, curve, scale=self._scale)
            self._finish(ax, int(curve.layers.max()) + 1, f"{self.name}: {curve.label}")
        self.ax_ = axes[0]
        return self

    @property
    def _scale(self) -> float:
        return PERCENT if self.is_side else 1.0

    def _finish(self, axes: "Axes", layers: int, title: str) -> None:
        plain(axes)
        if self.is_side:
            accuracy_axis(axes)
        else:
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, 0.0), max(high, 1.05))
        layer_axis(axes, layers)
        axes.tick_params(labelleft=True)
        axes.set_title(title, fontsize=9, loc="left")


def layer_curve(
    results: ProbeResults,
    view: str | None = None,
    iterations: Iterations = "all",
    categories: Sequence[str] | None = None,
) -> "Figure":
    """Return a figure of held-out score by layer for every category (`figure.savefig(…)`).

    Backbone beside action, which has a line per iteration on one scale of colours; iterations: `all`, or `best`
    for the best of every layer, `last`, or one by number. Bars: each layer's 95 % interval, where the stream runs
    once. Filled markers are above chance against the best site of their stream (family-wise p < 0.05), and above
    every control that was run. Grey: chance, and the band that holds 95 % of the scores under label permutation;
    of a label at the best site of each layer, with the best control. view: the first probed one by default.
    categories: all by default. Raises UnknownSiteError for a view that was not probed, UsageError for an
    iteration.
    """
    view, names = known_view(results, view), categories or results.settings.categories
    displays = [LayerCurveDisplay.from_results(results, name, view, iterations) for name in names]
    figure, grid = _pairs(displays)
    _complete(figure, grid, displays)
    return figure


def _pairs(displays: Sequence[LayerCurveDisplay], in_pyplot: bool = False) -> "tuple[Figure, list[list[Axes]]]":
    """Axes for every stream of every display, those of one display side by side.

    in_pyplot: whether pyplot shall know the figure, so that it is shown where displays are.
    """
    from matplotlib import pyplot as plt

    from probe_kit.retention.displays.shown_figure import ShownFigure

    streams = max(len(display.streams) for display in displays)
    across = 1 if len(displays) == 1 else max(1, 4 // streams)
    rows = ceil(len(displays) / across)
    size = (max(6.2, 2.75 * streams * across + 0.7), (2.9 if rows == 1 else 2.3) * rows + 1.0)
    figure: Figure
    if in_pyplot:
        figure = plt.figure(figsize=size, layout="constrained", dpi=DPI, FigureClass=ShownFigure)
    else:
        figure = ShownFigure(figsize=size, layout="constrained", dpi=DPI)
    flat = list(figure.subplots(rows, across * streams, sharey=True, squeeze=False).flat)
    grid = [flat[streams * number : streams * (number + 1)] for number in range(len(flat) // streams)]
    for unused in (ax for pair in grid[len(displays) :] for ax in pair):
        unused.set_visible(False)
    return figure, grid[: len(displays)]


def _complete(figure: "Figure", grid: "list[list[Axes]]", displays: Sequence[LayerCurveDisplay]) -> None:
    for display, axes in zip(displays, grid, strict=True):
        display.plot_beside(axes)
        for unused in axes[len(display.streams) :]:
            unused.set_visible(False)
    if not displays[0].is_side:
        ranges = [ax.get_ylim() for axes in grid for ax in axes]
        grid[0][0].set_ylim(min(low for low, _ in ranges), max(high for _, high in ranges))
    figure.supylabel(displays[0].measure, fontsize=9)
    caption(figure, displays[0].certificate)
    drawn = [handle for label, handle in legend_handles(*grid[0]).items() if not label.startswith("iteration")]
    drawn += [*significance_handles(), _peak_handle()]
    legend_above(figure, drawn)
    _draw_scales(figure, grid, displays)


def _draw_scales(figure: "Figure", grid: "list[list[Axes]]", displays: Sequence[LayerCurveDisplay]) -> None:
    """The scale of iterations, once per figure."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm

    most = max((curve for display in displays for curve in display.streams), key=lambda curve: len(curve.lines))
    if len(most.lines) == 1:
        return
    steps = [line.iteration or 0 for line in most.lines]
    edges = [step - 0.5 for step in steps] + [steps[-1] + 0.5]
    scale = ScalarMappable(BoundaryNorm(edges, 256), _colours())
    bar = figure.colorbar(scale, ax=[ax for axes in grid for ax in axes], aspect=40, pad=0.01, ticks=_few(steps))
    bar.set_label("iteration of the action", fontsize=8)
    bar.ax.tick_params(labelsize=8, length=0)
    bar.outline.set_visible(False)


def _few(steps: Sequence[int]) -> list[int]:
    return list(steps[:: max(1, ceil(len(steps) / 12))])


def _colours() -> "Colormap":
    """Return colours from pale to dark through the action's: lightness alone orders the iterations."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("iterations", ["#F7C79B", PARTS["action"].colour, "#3B1200"])


def _draw_stream(axes: "Axes", curve: StreamCurve, sidestep: float = 0.0, scale: float = PERCENT) -> None:
    line = PARTS[curve.part]
    if len(curve.lines) == 1:
        draw_line(axes, curve.lines[0], line, curve.label, sidestep, bars=_has_bars(curve), scale=scale)
    else:
        colours = _colours()
        for number, layers in enumerate(curve.lines):
            shade = Line(colours(number / (len(curve.lines) - 1)), line.marker)  # type: ignore[arg-type]
            draw_line(axes, layers, shade, f"iteration {layers.iteration}", sidestep, bars=False, scale=scale)
        axes.plot([], [], color=line.colour, marker=line.marker, ms=4, lw=1.3, label=f"{curve.name}, by iteration")
    mark_peaks(axes, curve, sidestep, scale)


def _has_bars(curve: StreamCurve) -> bool:
    """Whether each layer has an interval of its own: the stream runs once."""
    return len(curve.lines) == 1 and curve.iterations == 1


def draw_line(
    axes: "Axes",
    line: LayerLine,
    style: Line,
    name: str,
    sidestep: float = 0.0,
    bars: bool = True,
    scale: float = PERCENT,
) -> None:
    """Draw one line; filled markers where it is significant. bars: each layer's own 95 % interval.

    A layer that was chosen, such as the best iteration's, has no interval of its own. scale: 100 for percent, on
    whose fixed axis scores that lie below are marked at the edge.
    """
    layers, scores = line.layers + sidestep, scale * line.score
    if bars:
        arms = np.array([scores - scale * line.low, scale * line.high - scores]).clip(min=0)
        axes.errorbar(
            layers, scores, yerr=arms, fmt="none", ecolor=style.colour, elinewidth=0.8, alpha=0.7
        )  # fmt: skip
    size = 4.5 if bars else 3.2
    axes.plot(
        layers, scores, color=style.colour, lw=1.3, ls=style.dash, marker=style.marker, ms=size, mfc="white",
        label=name,
    )  # fmt: skip
    clear = line.significant
    axes.plot(layers[clear], scores[clear], color=style.colour, ls="none", marker=style.marker, ms=size)
    if scale == PERCENT:
        mark_below(axes, layers, scores, style.colour)


def mark_peaks(axes: "Axes", curve: StreamCurve, sidestep: float = 0.0, scale: float = PERCENT) -> None:
    """Mark every site that no other one of its stream beats, and above its error bar where it has one."""
    from matplotlib.transforms import ScaledTranslation

    figure = axes.figure
    layers = sorted({layer for layer, _ in curve.peaks})
    above = axes.transData + ScaledTranslation(0, 5 / 72, figure.dpi_scale_trans)
    best = dict(zip(curve.layers.tolist(), curve.score.tolist(), strict=True))
    top = {layer: best[layer] for layer in layers}
    if _has_bars(curve):
        line = curve.lines[0]
        high = dict(zip(line.layers.tolist(), line.high.tolist(), strict=True))
        top = {layer: np.fmax(value, high[layer]) for layer, value in top.items()}
    (mark,) = axes.plot(
        [layer + sidestep for layer in layers], [scale * top[layer] for layer in layers], ls="none",
        marker=_MARK, ms=5, color="black", transform=above, clip_on=False, zorder=4,
    )  # fmt: skip
    mark.set_gid("peak")


_MARK: Literal[7] = 7  # matplotlib's caret that points down, with its tip at the place


def _peak_handle() -> "Line2D":
    from matplotlib.lines import Line2D

    return Line2D([], [], color="black", ls="none", marker=_MARK, ms=5, label=_PEAK)


@in_report(9)
def layer_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    for drawn in source.runs:
        views = () if drawn.results is None else drawn.results.settings.views
        for view in views:
            assert drawn.results is not None
            yield ReportFigure(
                f"{drawn.stem}-layer-curves{view_suffix(view, views)}", in_view("Layer curves", view, views),
                "probes",
                "How often a linear probe names the side of the correct picture in episodes it has not seen, "
                f"layer by layer; the part that makes the action has a line per iteration. {ONLY_FILLED}, against "
                "the best layer of permuted labels. The grey band is what no knowledge looks like; a caret "
                "marks the best layer, or all that tie.",
                drawn.position, partial(layer_curve, drawn.results, view, source.table.iterations),
                is_detail=view != views[0],
            )  # fmt: skip


@in_report(9, "labels")
def label_layer_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield the figures that a report of these labels shows."""
    iterations = "best" if source.table.iterations == "all" else source.table.iterations
    for view in label_views(source):
        yield view.figure(
            "layer-curves", "Layer curves",
            "How well a linear probe decodes the label in groups it has not seen, layer by layer, with 95 % "
            f"intervals over groups. {ONLY_FILLED}. Grey: what the same probes reach with labels exchanged "
            "between groups. Dotted: the best control.",
            layer_curve, iterations, [view.category],
        )  # fmt: skip
