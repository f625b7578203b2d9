"""Layer curves: score by layer, the backbone next to where the action is made, a line per iteration."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.types import Matrix
from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.choices import Iterations
from probe_kit.retention.columns.text import name_of_target
from probe_kit.retention.displays.display import (
    PARTS,
    Display,
    LineLook,
    ProvenanceLine,
    accuracy_axis,
    best_of,
    draw_intervals,
    in_panels,
    known_view,
    layer_axis,
    legend_above,
    legend_handles,
    mark_below,
    probed_curve,
    scores_of,
    significance_handles,
)
from probe_kit.retention.displays.report_figure import (
    ONLY_FILLED,
    FigureSource,
    ReportFigure,
    in_report,
    probed_views,
)
from probe_kit.statistics.sufficiency import FEWEST_PERMUTATIONS
from probe_kit.train.choices import SIDES
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D


def select_iterations(scores: "pd.DataFrame", iterations: Iterations) -> "pd.DataFrame":
    """Return the rows of one stream that take part; all of a stream that runs once.

    Args:
        scores: Rows of `ProbeResults.scores` of one stream.
        iterations: The choice of iterations.

    Raises:
        UsageError: If the stream has no such iteration.
    """
    steps = scores["iteration"].dropna()
    if iterations in ("all", "best") or steps.empty:
        return scores
    step = int(steps.max()) if iterations == "last" else iterations
    if not (steps == step).any():
        stream = scores["stream"].iloc[0]
        raise UsageError(f"the stream {stream} has iterations {steps.min()} to {steps.max()}, not {step}")
    return scores[scores["iteration"] == step]


@dataclass(frozen=True)
class LayerLine:
    """Held-out score by layer; arrays (L,), accuracies as shares or R², with their 95 % interval over groups.

    Attributes:
        iteration: Iteration of all values, None where the stream runs once or where every layer has its best one.
        significant: Above chance, family-wise, and above the controls that were run.
    """

    iteration: int | None
    layers: NDArray[Any]
    score: Matrix
    low: Matrix
    high: Matrix
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

    Attributes:
        part: Part of the model, see `Stream.part`.
        sites: The L best sites among the iterations that are shown, of a label by the score above their own
            chance; `score` is theirs.
        depth: The layer as a fraction.
        iterations: Number of iterations that are shown.
        lines: The lines that are drawn: one per iteration, or the best.
        peaks: (layer, iteration) of the best sites, all of them where several tie.
    """

    stream: str
    part: str
    sites: tuple[str, ...]
    depth: Matrix
    iterations: int
    lines: tuple[LayerLine, ...]
    peaks: tuple[tuple[int, int | None], ...]

    @classmethod
    def of_stream(cls, scores: "pd.DataFrame", iterations: Iterations = "best") -> Self:
        """Read the rows of one category, view and stream of `ProbeResults.scores`.

        Args:
            scores: Rows of one category, view and stream.
            iterations: The choice of iterations; `all` gives a line for each.

        Raises:
            UsageError: If the stream has no such iteration.
        """
        scores = select_iterations(scores, iterations)
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
        """The common name of the stream."""
        return label_of(self.stream)

    @property
    def label(self) -> str:
        """The name, and the iterations that are shown if not all are."""
        if self.iterations > 1:
            return f"{self.name}, best iteration" if len(self.lines) == 1 else self.name
        step = self.lines[0].iteration
        return self.name if step is None else f"{self.name}, iteration {step}"


_SIDESTEP = 0.1  # of a layer, so that the bars of two streams on one axes do not hide each other

_PEAK = "best of its stream (all, where several tie)"
_ITERATION = "iteration "
PERCENT = 100.0


@dataclass(frozen=True)
class Ground:
    """The chance, band and control that the scores of one stream are compared with; arrays (L,) by layer.

    Attributes:
        chance: One half for a side, else the mean score of the label permutations at the layer's best site; NaN
            without any.
        null_band: Ends of the range that holds 95 % of the scores under label permutation, of a side those of all
            sites; None below 20 permutations.
        control: Name and score of the best control of a label.
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
        null = every if curve.balanced else curve.null[rows]
        ends = np.percentile(null, [2.5, 97.5], axis=1) if curve.null.shape[1] >= FEWEST_PERMUTATIONS else None
        controls = () if curve.balanced else results.controls.of_stream(category, view, stream.stream)
        return cls(
            curve.chance[rows],
            None if ends is None else (ends[0], ends[1]),
            (controls[0].name, controls[0].score) if controls else None,
        )

    def draw(self, axes: "Axes", layers: NDArray[Any], scale: float) -> None:
        """Draw the band, chance and the best control.

        Args:
            axes: Axes to draw on.
            layers: (L,) layer numbers.
            scale: Factor on scores, 100 for percent.
        """
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


@dataclass(kw_only=True)
class LayerCurveDisplay(Display):
    """Held-out score by layer, for one category in one view: accuracy of a side, metric of a label.

    Filled markers are above chance against the best site of their stream (family-wise p < 0.05), and above every
    control that was run.

    Attributes:
        grounds: Chance, band and control that the scores are compared with, one per stream.
    """

    target: str
    metric: str
    category: str
    view: str
    streams: tuple[StreamCurve, ...]
    grounds: tuple[Ground, ...]
    panel_size: ClassVar = (2.75, 2.3)

    @classmethod
    def from_results(
        cls,
        results: ProbeResults,
        category: str | None = None,
        view: str | None = None,
        iterations: Iterations = "all",
    ) -> Self:
        """Read stored probes.

        Args:
            results: Probes of one run.
            category: A probed category; None for the first.
            view: A probed view; None for the first.
            iterations: A line for each of `all`, for the `best` of every layer, for the `last` one or one by
                number.

        Raises:
            UnknownSiteError: For a view that was not probed.
            UnknownCategoryError: For a category that was not probed.
            UsageError: For an iteration that no stream has.
        """
        category, view, _ = probed_curve(results, view, category)
        scores, settings = scores_of(results, category, view), results.settings
        streams = tuple(
            StreamCurve.of_stream(rows, iterations) for _, rows in scores.groupby("stream", sort=False)
        )
        metric = METRICS[settings.task]
        return cls(
            title=name_of_target(settings.target, category),
            measure="held-out accuracy (%)" if settings.balanced else f"held-out {metric}",
            is_level=not settings.balanced,  # panels of accuracies have a fixed range
            figure_size=(2.75, 2.9),
            target=settings.target,
            metric=metric,
            category=category,
            view=view,
            streams=streams,
            grounds=tuple(Ground.of(results, category, view, stream) for stream in streams),
            certificates=(ProvenanceLine.of_results(results, view, None if settings.balanced else category),),
        )

    @property
    def in_percent(self) -> bool:
        """Whether scores are drawn in percent on one scale, as the accuracies of a side."""
        return self.target in SIDES

    @property
    def by_stream(self) -> "list[LayerCurveDisplay]":
        """The streams as displays of their own."""
        return [
            replace(self, streams=(stream,), grounds=(ground,), title=f"{self.title}: {stream.label}")
            for stream, ground in zip(self.streams, self.grounds, strict=True)
        ]

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw all streams on `ax`, or each in a panel of its own on a figure with legend and caption."""
        if ax is not None:
            return super().plot(ax)
        panels_of = self.by_stream
        in_panels(panels_of, self.figure_size, len(panels_of), in_pyplot=True)
        self.ax_ = panels_of[0].ax_
        return self

    def draw(self, axes: "Axes") -> None:
        """Draw the ground of the first stream, and all streams."""
        scale = PERCENT if self.in_percent else 1.0
        self.grounds[0].draw(axes, self.streams[0].layers, scale)
        for number, curve in enumerate(self.streams):
            _draw_stream(axes, curve, _SIDESTEP * (number - (len(self.streams) - 1) / 2), scale)
        if self.in_percent:
            accuracy_axis(axes)
        else:
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, 0.0), max(high, 1.05))
        layer_axis(axes, int(max(curve.layers.max() for curve in self.streams)) + 1)

    def further_handles(self) -> "Sequence[Artist]":
        """Return the handles of filled and open markers and of the caret."""
        return [*significance_handles(), _peak_handle()]

    def finish(self, figure: "Figure", grid: "Sequence[Axes]") -> None:
        """Add a legend, in which iterations have one name, and the scale of their colours."""
        names = legend_handles(*grid).items()
        drawn = [handle for label, handle in names if not label.startswith(_ITERATION)]
        legend_above(figure, [*drawn, *self.further_handles()])
        _draw_scale(figure, grid)


def layer_curve(
    results: ProbeResults,
    view: str | None = None,
    iterations: Iterations = "all",
    categories: Sequence[str] | None = None,
) -> "Figure":
    """Return a figure of held-out score by layer for every category (`figure.savefig(…)`).

    The backbone is drawn next to the action, which has a line per iteration on one scale of colours. Bars: each
    layer's 95 % interval, where the stream runs once. Filled markers are above chance against the best site of
    their stream (family-wise p < 0.05), and above every control that was run. Grey: chance, and the band that
    holds 95 % of the scores under label permutation. For a label, both are at the best site of each layer, and the
    best control is drawn too.

    Args:
        results: Probes of one run.
        view: A probed view; None for the first.
        iterations: `all`, or `best` for the best of every layer, `last`, or one by number.
        categories: The categories that are drawn; None for all.

    Raises:
        UnknownSiteError: For a view that was not probed.
        UsageError: For an iteration that no stream has.
    """
    view, names = known_view(results, view), categories or results.settings.categories
    displays = [LayerCurveDisplay.from_results(results, name, view, iterations) for name in names]
    streams = max(len(display.streams) for display in displays)
    # A category that was probed in fewer streams leaves places empty, so that columns stay those of one stream.
    panels_of: list[LayerCurveDisplay | None] = []
    for display in displays:
        panels_of += [*display.by_stream, *[None] * (streams - len(display.streams))]
    pairs_in_a_row = 1 if len(displays) == 1 else max(1, 4 // streams)
    return in_panels(panels_of, columns=streams * pairs_in_a_row)


def _draw_scale(figure: "Figure", grid: "Sequence[Axes]") -> None:
    """Draw the scale of iterations, where a panel has lines of several."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm

    labels = [label for label in legend_handles(*grid) if label.startswith(_ITERATION)]
    steps = sorted(int(label.removeprefix(_ITERATION)) for label in labels)
    if len(steps) < 2:
        return
    edges = [step - 0.5 for step in steps] + [steps[-1] + 0.5]
    scale = ScalarMappable(BoundaryNorm(edges, 256), _colours())
    ticks = steps[:: max(1, ceil(len(steps) / 12))]
    bar = figure.colorbar(scale, ax=list(grid), aspect=40, pad=0.01, ticks=ticks)
    bar.set_label("iteration of the action", fontsize=8)
    bar.ax.tick_params(labelsize=8, length=0)
    bar.outline.set_visible(False)


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
            shade = LineLook(colours(number / (len(curve.lines) - 1)), line.marker)  # type: ignore[arg-type]
            draw_line(axes, layers, shade, f"{_ITERATION}{layers.iteration}", sidestep, bars=False, scale=scale)
        axes.plot([], [], color=line.colour, marker=line.marker, ms=4, lw=1.3, label=f"{curve.name}, by iteration")
    mark_peaks(axes, curve, sidestep, scale)


def _has_bars(curve: StreamCurve) -> bool:
    """Whether each layer has an interval of its own: the stream runs once."""
    return len(curve.lines) == 1 and curve.iterations == 1


def draw_line(
    axes: "Axes",
    line: LayerLine,
    style: LineLook,
    name: str,
    sidestep: float = 0.0,
    bars: bool = True,
    scale: float = PERCENT,
) -> None:
    """Draw one line; filled markers where it is significant.

    A layer that was chosen, such as the best iteration's, has no interval of its own.

    Args:
        axes: Axes to draw on.
        line: Scores by layer.
        style: Colour, marker and dash.
        name: Entry in the legend.
        sidestep: Shift along the layers, so that bars of two lines do not hide each other.
        bars: Whether each layer's own 95 % interval is drawn.
        scale: Factor on scores; 100 for percent, on whose fixed axis lower scores are marked at the edge.
    """
    layers, scores = line.layers + sidestep, scale * line.score
    if bars:
        draw_intervals(axes, layers, scores, style.colour, [scale * line.low, scale * line.high])
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
    """Mark every site that no other one of its stream exceeds, above its error bar where it has one."""
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


@in_report(9, "sides", "labels")
def layer_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield the layer curves of the probed views of runs or labels."""
    for view in probed_views(source):
        if view.category is None:
            yield view.figure(
                "layer-curves", "Layer curves",
                "How often a linear probe names the side of the correct picture in episodes it has not seen, "
                f"layer by layer; the part that makes the action has a line per iteration. {ONLY_FILLED}, against "
                "the best layer of permuted labels. The grey band is what no knowledge looks like; a caret "
                "marks the best layer, or all that tie.",
                layer_curve, source.table.iterations,
            )  # fmt: skip
        else:
            yield view.figure(
                "layer-curves", "Layer curves",
                "How well a linear probe decodes the label in groups it has not seen, layer by layer, with 95 % "
                f"intervals over groups. {ONLY_FILLED}. Grey: what the same probes reach with labels exchanged "
                "between groups. Dotted: the best control.",
                layer_curve, best_of(source.table.iterations), [view.category],
            )  # fmt: skip
