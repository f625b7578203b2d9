"""Role-resolved curves: whose tokens carry the answer, by depth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Self

from probe_kit.errors import UnknownSiteError
from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.choices import Iterations
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.base.display import Display
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import FigureSource, ReportFigure
from probe_kit.retention.displays.base.selection import curve_of, scores_of
from probe_kit.retention.displays.base.style import (
    accuracy_axis,
    axes_for,
    caption,
    layer_axis,
    legend_above,
    panels,
    plain,
    series,
    significance_handles,
)
from probe_kit.retention.displays.layer_curves import draw_line
from probe_kit.retention.displays.stream_curve import StreamCurve
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass
class RoleCurvesDisplay(Display):
    """Held-out accuracy by layer, one line per view of one stream, for one category.

    curves: by view, such as `mean:language`; of iterative streams, the best of the iterations at each layer.
    """

    category: str
    stream: str
    chance: float
    curves: dict[str, StreamCurve]
    certificate: ProvenanceLine
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

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
                curves[view] = StreamCurve.of(rows, "best" if iterations == "all" else iterations)
        if not curves:
            raise UnknownSiteError(f"none of the views {', '.join(candidates)} was probed in stream {stream!r}")
        first = next(iter(curves))
        return cls(
            category=category,
            stream=stream,
            chance=CHANCE,
            curves=curves,
            certificate=ProvenanceLine.of_results(results, first),
        )

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        axes, figure = axes_for(ax, 6.2, 3.9)
        axes.axhline(100 * self.chance, color="0.45", lw=1, ls=(0, (1, 1)), label="chance")
        spread = 0.1
        for position, (view, curve) in enumerate(self.curves.items()):
            sidestep = spread * (position - (len(self.curves) - 1) / 2)
            draw_line(axes, curve.lines[0], series(position), view, sidestep)
        plain(axes)
        accuracy_axis(axes)
        layer_axis(axes, int(max(curve.layers.max() for curve in self.curves.values())) + 1)
        axes.set_title(title_of(self.category), fontsize=10, loc="left")
        if figure is not None:
            axes.set_ylabel(_label(self.stream), fontsize=9)
            _draw_legend(figure, axes)
        caption(figure, self.certificate)
        self.ax_ = axes
        return self


def role_curves(
    results: ProbeResults,
    stream: str = "backbone",
    views: Sequence[str] | None = None,
    iterations: Iterations = "best",
) -> "Figure":
    """Curves of all probed views of one stream, a panel per category. Raises UnknownSiteError without any."""
    categories = results.settings.categories
    displays = [RoleCurvesDisplay.from_results(results, name, stream, views, iterations) for name in categories]
    figure, grid = panels(len(displays))
    for display, axes in zip(displays, grid, strict=True):
        display.plot(axes)
    figure.supylabel(_label(stream), fontsize=9)
    caption(figure, displays[0].certificate)
    _draw_legend(figure, grid[0])
    return figure


def _label(stream: str) -> str:
    return f"held-out accuracy (%), {label_of(stream)}"


def _draw_legend(figure: "Figure", panel: "Axes") -> None:
    handles = [*panel.get_legend_handles_labels()[0], *significance_handles()]
    legend_above(figure, handles)


PLACE = 11
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
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
