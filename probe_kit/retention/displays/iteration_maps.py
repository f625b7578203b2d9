"""Layer × iteration maps: where and when in the action expert the answer can be read."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.display import Display, curve_of, known_view, scores_of
from probe_kit.retention.displays.report_figure import (
    DOTS,
    FigureSource,
    ReportFigure,
    in_report,
    in_view,
    view_suffix,
)
from probe_kit.retention.displays.style import (
    FILLED,
    PARTS,
    ProvenanceLine,
    axes_for,
    caption,
    legend_above,
    panels,
)
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.figure import Figure


@dataclass
class IterationMapDisplay(Display):
    """Held-out accuracy at every layer and iteration of one stream, for one category in one view.

    accuracy: (I, L) shares. significant: (I, L), above chance against the best site of the stream, and
    above the controls that were run. layers, iterations: the numbers along both sides, (L,) and (I,). Colours run
    from chance to 100 % in every map of every run.
    """

    category: str
    view: str
    stream: str
    part: str
    layers: NDArray[np.int64]
    iterations: NDArray[np.int64]
    accuracy: NDArray[np.float64]
    significant: NDArray[np.bool_]
    certificate: ProvenanceLine

    @classmethod
    def from_results(
        cls, results: ProbeResults, category: str, view: str | None = None, stream: str | None = None
    ) -> Self:
        """Read stored probes; view: the first probed one by default; stream: where the action is made.

        Raises UnknownSiteError for a view that was not probed or a stream without iterations,
        UnknownCategoryError for a category that was not probed, UsageError for a target that is no side.
        """
        view = known_view(results, view)
        curve = curve_of(results, category, view)
        scores = scores_of(results, category, view)
        stream = stream or curve.action_stream
        if not curve.is_side:
            raise UsageError(
                f"a map of iterations is of a side; these probes are of {results.settings.target!r}. "
                "Draw their layer curve with iterations='all'"
            )
        scores = scores[(scores["stream"] == stream) & scores["iteration"].notna()]
        if scores.empty:
            raise UnknownSiteError(f"stream {stream!r} in view {view!r} has no iterations; see the layer curve")
        grid = scores.pivot(index="iteration", columns="layer", values=["accuracy", "signal"])
        return cls(
            category=category,
            view=view,
            stream=str(stream),
            part=str(scores["part"].iloc[0]),
            layers=grid["accuracy"].columns.to_numpy(dtype=np.int64),
            iterations=grid.index.to_numpy(dtype=np.int64),
            accuracy=grid["accuracy"].to_numpy(dtype=float),
            significant=grid["signal"].to_numpy(dtype=bool),
            certificate=ProvenanceLine.of_results(results, view),
        )

    @property
    def peaks(self) -> tuple[tuple[int, int], ...]:
        """Positions (iteration, layer) of the most accurate site, of all of them where several tie."""
        best = np.argwhere(self.accuracy >= self.accuracy.max() - 1e-12)
        return tuple((int(iteration), int(layer)) for iteration, layer in best)

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with colour bar and caption."""
        axes, figure = axes_for(ax, 5.2, 3.6)
        drawn = draw_map(axes, self)
        if figure is not None:
            axes.set_ylabel("iteration", fontsize=9)
            draw_keys(figure, [axes], drawn)
            caption(figure, self.certificate)
        self.ax_ = axes
        return self


def iteration_maps(results: ProbeResults, view: str | None = None, stream: str | None = None) -> "Figure":
    """A layer × iteration map of every category on one scale of colours.

    Raises UnknownSiteError for a view that was not probed or a stream without iterations.
    """
    categories = results.settings.categories
    displays = [IterationMapDisplay.from_results(results, name, view, stream) for name in categories]
    figure, grid = panels(len(displays), width=2.7, height=2.1)
    for display, axes in zip(displays, grid, strict=True):
        drawn = draw_map(axes, display)
    figure.supylabel("iteration", fontsize=9)
    draw_keys(figure, grid, drawn)
    caption(figure, displays[0].certificate)
    return figure


def draw_map(axes: "Axes", display: IterationMapDisplay) -> "ScalarMappable":
    """One map on `axes`; what it returns makes the colour bar."""
    from matplotlib.colors import Normalize
    from matplotlib.patches import Rectangle
    from matplotlib.patheffects import withStroke

    norm = Normalize(100 * CHANCE, 100)
    colours = _colours(display.part)
    image = axes.imshow(100 * display.accuracy, cmap=colours, norm=norm, aspect="auto", origin="lower")
    iterations, layers = display.accuracy.shape
    for iteration, layer in np.argwhere(display.significant):
        ink = _ink(100 * display.accuracy[iteration, layer], norm)
        axes.plot(layer, iteration, marker="o", ms=2.2, color=ink, mew=0)
    for iteration, layer in display.peaks:
        frame = Rectangle((layer - 0.5, iteration - 0.5), 1, 1, fill=False, ec="black", lw=1.2, zorder=3)
        frame.set_path_effects([withStroke(linewidth=2.6, foreground="white")])
        axes.add_patch(frame)
    for ticks, numbers, axis in (
        (layers, display.layers, axes.xaxis),
        (iterations, display.iterations, axes.yaxis),
    ):
        labelled = range(0, ticks, max(1, -(-ticks // 7)))
        axis.set_ticks(list(labelled), [str(numbers[at]) for at in labelled])
    axes.set_xlabel("layer", fontsize=8.5)
    axes.tick_params(labelsize=8)
    axes.set_title(title_of(display.category), fontsize=10, loc="left")
    return image


def _colours(part: str) -> "Colormap":
    """White at chance, through the part's colour, to nearly black: lightness alone orders the cells."""
    from matplotlib.colors import LinearSegmentedColormap

    colour = PARTS[part].colour
    dark = "#331400" if part == "action" else "#001B2E"
    return LinearSegmentedColormap.from_list(part, ["#FFFFFF", colour, dark]).with_extremes(under="0.93")


def _ink(value: float, norm: "Normalize") -> str:
    return "white" if norm(value) > 0.45 else "black"  # the colours get dark in their middle


def draw_keys(figure: "Figure", grid: "list[Axes]", drawn: "ScalarMappable") -> None:
    """The colour bar of maps, and the legend of dots, frames and grey cells."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Artist] = [
        Line2D([], [], color="0.3", ls="none", marker="o", ms=3, label=FILLED.removeprefix("filled: ")),
        Patch(fill=False, ec="black", lw=1.4, label="best of its stream (all, where several tie)"),
        Patch(fc="0.93", label="below chance"),
    ]
    bar = figure.colorbar(drawn, ax=grid, extend="min", aspect=30, shrink=0.9, pad=0.01)
    bar.set_label("held-out accuracy (%)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)
    bar.set_ticks(range(50, 101, 10))
    legend_above(figure, handles)


@in_report(10)
def map_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    for drawn in source.runs:
        if drawn.results is None:
            continue
        views, scores = drawn.results.settings.views, drawn.results.scores
        for view in views:
            for stream in scores.loc[scores["part"] == "action", "stream"].unique():
                of_stream = (scores["view"] == view) & (scores["stream"] == stream)
                if (of_stream & scores["iteration"].notna()).any():
                    yield ReportFigure(
                        f"{drawn.stem}-iteration-maps{view_suffix(view, views)}",
                        in_view("Layer × iteration", view, views), "probes",
                        "The action is made in several iterations (flow-matching steps or action tokens). The "
                        "further a cell's colour is from that of chance, the better the answer can be read "
                        f"there. {DOTS}.",
                        drawn.position, partial(iteration_maps, drawn.results, view, stream), is_detail=True,
                    )  # fmt: skip
