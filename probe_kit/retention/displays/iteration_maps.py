"""Layer × iteration maps: where and when in the action expert the answer can be read."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.display import (
    FILLED,
    PARTS,
    Display,
    ProvenanceLine,
    curve_of,
    in_panels,
    known_view,
    legend_above,
    scores_of,
)
from probe_kit.retention.displays.report_figure import (
    DOTS,
    FigureSource,
    ReportFigure,
    in_report,
    probed_views,
)
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure


@dataclass(kw_only=True)
class IterationMapDisplay(Display):
    """Held-out accuracy at every layer and iteration of one stream, for one category in one view.

    Colours run from chance to 100 % in every map of every run.

    Attributes:
        layers: (L,) numbers along the lower side.
        iterations: (I,) numbers along the upright side.
        accuracy: (I, L) shares.
        significant: (I, L), above chance against the best site of the stream, and above the controls that were
            run.
    """

    category: str
    view: str
    stream: str
    part: str
    layers: NDArray[np.int64]
    iterations: NDArray[np.int64]
    accuracy: NDArray[np.float64]
    significant: NDArray[np.bool_]
    panel_size: ClassVar = (2.7, 2.1)
    is_framed: ClassVar = True
    title_size: ClassVar = 10

    @classmethod
    def from_results(
        cls, results: ProbeResults, category: str, view: str | None = None, stream: str | None = None
    ) -> Self:
        """Read stored probes of a side.

        Args:
            results: Probes of one run.
            category: The category that is drawn.
            view: A probed view; None for the first.
            stream: A stream with iterations; None for the one where the action is made.

        Raises:
            UnknownSiteError: For a view that was not probed or a stream without iterations.
            UnknownCategoryError: For a category that was not probed.
            UsageError: For a target that is no side.
        """
        view = known_view(results, view)
        curve = curve_of(results, category, view)
        scores = scores_of(results, category, view)
        stream = stream or curve.action_stream
        if not curve.balanced:
            raise UsageError(
                f"a map of iterations is of a side; these probes are of {results.settings.target!r}. "
                "Draw their layer curve with iterations='all'"
            )
        scores = scores[(scores["stream"] == stream) & scores["iteration"].notna()]
        if scores.empty:
            raise UnknownSiteError(f"stream {stream!r} in view {view!r} has no iterations; see the layer curve")
        grid = scores.pivot(index="iteration", columns="layer", values=["accuracy", "signal"])
        return cls(
            title=title_of(category),
            measure="iteration",
            category=category,
            view=view,
            stream=str(stream),
            part=str(scores["part"].iloc[0]),
            layers=grid["accuracy"].columns.to_numpy(dtype=np.int64),
            iterations=grid.index.to_numpy(dtype=np.int64),
            accuracy=grid["accuracy"].to_numpy(dtype=float),
            significant=grid["signal"].to_numpy(dtype=bool),
            certificates=(ProvenanceLine.of_results(results, view),),
        )

    @property
    def peaks(self) -> tuple[tuple[int, int], ...]:
        """Positions (iteration, layer) of the most accurate site, of all of them where several tie."""
        best = np.argwhere(self.accuracy >= self.accuracy.max() - 1e-12)
        return tuple((int(iteration), int(layer)) for iteration, layer in best)

    def draw(self, axes: "Axes") -> None:
        """Draw the cells, dots where they are evidence, and frames around the best."""
        from matplotlib.patches import Rectangle
        from matplotlib.patheffects import withStroke

        percent = 100 * self.accuracy
        axes.imshow(percent, cmap=_colours(self.part), vmin=_LEAST, vmax=100, aspect="auto", origin="lower")
        for iteration, layer in np.argwhere(self.significant):
            # The colours get dark in their middle.
            ink = "white" if percent[iteration, layer] > _LEAST + 0.45 * (100 - _LEAST) else "black"
            axes.plot(layer, iteration, marker="o", ms=2.2, color=ink, mew=0)
        for iteration, layer in self.peaks:
            frame = Rectangle((layer - 0.5, iteration - 0.5), 1, 1, fill=False, ec="black", lw=1.2, zorder=3)
            frame.set_path_effects([withStroke(linewidth=2.6, foreground="white")])
            axes.add_patch(frame)
        for numbers, axis in ((self.layers, axes.xaxis), (self.iterations, axes.yaxis)):
            labelled = range(0, numbers.size, max(1, -(-numbers.size // 7)))
            axis.set_ticks(list(labelled), [str(numbers[at]) for at in labelled])
        axes.set_xlabel("layer", fontsize=8.5)
        axes.tick_params(labelsize=8)

    def finish(self, figure: "Figure", grid: "Sequence[Axes]") -> None:
        """Add the colour bar, and the legend of dots, frames and grey cells."""
        from matplotlib.lines import Line2D
        from matplotlib.patches import Patch

        handles: list[Artist] = [
            Line2D([], [], color="0.3", ls="none", marker="o", ms=3, label=FILLED.removeprefix("filled: ")),
            Patch(fill=False, ec="black", lw=1.4, label="best of its stream (all, where several tie)"),
            Patch(fc="0.93", label="below chance"),
        ]
        bar = figure.colorbar(grid[0].images[0], ax=list(grid), extend="min", aspect=30, shrink=0.9, pad=0.01)
        bar.set_ticks(range(50, 101, 10))
        bar.set_label("held-out accuracy (%)", fontsize=8)
        bar.ax.tick_params(labelsize=8)
        bar.outline.set_visible(False)
        legend_above(figure, handles)


def iteration_maps(results: ProbeResults, view: str | None = None, stream: str | None = None) -> "Figure":
    """Return a figure with a layer × iteration map of every category on one scale of colours.

    Args:
        results: Probes of one run.
        view: A probed view; None for the first.
        stream: A stream with iterations; None for the one where the action is made.

    Raises:
        UnknownSiteError: For a view that was not probed or a stream without iterations.
    """
    categories = results.settings.categories
    return in_panels([IterationMapDisplay.from_results(results, name, view, stream) for name in categories])


_LEAST = 100 * CHANCE
"""Percent at which colours begin."""


def _colours(part: str) -> "Colormap":
    """Return colours from white at chance, through the part's colour, to nearly black.

    Lightness alone orders the cells.
    """
    from matplotlib.colors import LinearSegmentedColormap

    dark = "#331400" if part == "action" else "#001B2E"
    colours = LinearSegmentedColormap.from_list(part, ["#FFFFFF", PARTS[part].colour, dark])
    return colours.with_extremes(under="0.93")


@in_report(10)
def map_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield a figure per probed view and iterative action stream of the runs."""
    for view in probed_views(source):
        scores = view.results.scores
        in_action = (scores["view"] == view.view) & (scores["part"] == "action")
        for stream in scores.loc[in_action & scores["iteration"].notna(), "stream"].unique():
            yield view.figure(
                "iteration-maps", "Layer × iteration",
                "The action is made in several iterations (flow-matching steps or action tokens). The "
                "further a cell's colour is from that of chance, the better the answer can be read "
                f"there. {DOTS}.",
                iteration_maps, stream, is_detail=True,
            )  # fmt: skip
