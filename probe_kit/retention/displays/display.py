"""The displays' base: a panel alone or beside others, its legend and caption; and the choice of what it shows."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UnknownCategoryError, UnknownSiteError, UsageError
from probe_kit.retention.choices import Iterations
from probe_kit.retention.displays.style import (
    Line,
    ProvenanceLine,
    caption,
    legend_above,
    legend_handles,
    panels,
    plain,
)
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from probe_kit.retention.displays.shown_figure import Picture


@dataclass(kw_only=True)
class Display(ABC):
    """One panel of numbers: on axes of its own, or beside others in one figure.

    A display that has been plotted shows its figure. title: above the panel. measure: name of the upright axis.
    certificates: where its numbers come from. figure_size: inches of a panel by itself; panel_size: of
    one of several. is_level: whether panels side by side have one range of the upright axis. is_framed: whether
    all spines are drawn. ax_: what `plot` drew on.
    """

    title: str = ""
    measure: str = ""
    certificates: tuple[ProvenanceLine, ...] = ()
    figure_size: tuple[float, float] = (6.2, 2.8)
    is_level: bool = False
    ax_: "Axes | None" = field(default=None, init=False, repr=False)
    panel_size: ClassVar[tuple[float, float]] = (3.1, 2.5)
    is_framed: ClassVar[bool] = False
    title_size: ClassVar[float] = 9

    @abstractmethod
    def draw(self, axes: "Axes") -> None:
        """Draw marks with labels for the legend, and the axes' scales."""

    def further_handles(self) -> "Sequence[Artist]":
        """Return handles of the legend, behind those of what is drawn."""
        return []

    def finish(self, figure: "Figure", grid: "Sequence[Axes]") -> None:
        """Add to a figure of one or more panels what all of them share: a legend with every name once."""
        if every := [*legend_handles(*grid).values(), *self.further_handles()]:
            legend_above(figure, every)

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        if ax is None:
            in_panels([self], self.figure_size, in_pyplot=True)
        else:
            self.draw_panel(ax)
            self.annotate()
        return self

    def draw_panel(self, axes: "Axes") -> None:
        """Draw on `axes`, with the title above."""
        self.draw(axes)
        if not self.is_framed:
            plain(axes)
        axes.set_title(self.title, fontsize=self.title_size, loc="left")
        self.ax_ = axes

    def annotate(self) -> None:  # noqa: B027 - most displays have nothing to write
        """Write what needs the marks' final places: after the layout of a figure of its own, else at once."""

    def _repr_png_(self) -> "Picture | None":
        """Return the figure, whatever pyplot's backend is."""
        if self.ax_ is None:
            return None
        from matplotlib import pyplot as plt
        from matplotlib.figure import Figure

        from probe_kit.retention.displays.shown_figure import picture_of

        figure = self.ax_.figure
        assert isinstance(figure, Figure)
        plt.close(figure)  # or the inline backend shows it once more below the cell
        return picture_of(figure)


def in_panels(
    displays: Sequence[Display | None],
    size: tuple[float, float] | None = None,
    columns: int | None = None,
    *,
    in_pyplot: bool = False,
) -> "Figure":
    """Return displays of one kind in one figure, under one legend.

    displays: one or more; None leaves a place empty. size: of a panel in inches, by default that of its kind.
    columns, in_pyplot: as in `panels`.
    """
    present = [display for display in displays if display is not None]
    first = present[0]
    figure, places = panels(len(displays), *(size or first.panel_size), columns, share=False, in_pyplot=in_pyplot)
    for display, axes in zip(displays, places, strict=True):
        if display is None:
            axes.set_visible(False)
        else:
            display.draw_panel(axes)
    grid = [axes for axes in places if axes.get_visible()]
    if first.is_level:
        ranges = [axes.get_ylim() for axes in grid]
        for axes in grid:
            axes.set_ylim(min(low for low, _ in ranges), max(high for _, high in ranges))
    figure.supylabel(first.measure, fontsize=9)
    caption(figure, *(line for display in present for line in display.certificates))
    first.finish(figure, grid)
    for display in present:
        display.annotate()
    return figure


def draw_series(
    axes: "Axes",
    line: Line,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    filled: NDArray[np.bool_],
    label: str,
    zorder: float = 2.0,
) -> None:
    """A line, with filled markers where it is significant and open ones elsewhere. x, y, filled: (K,)."""
    axes.plot(x, y, color=line.colour, ls=line.dash, lw=1.6, label=label, zorder=zorder)
    for is_filled in (True, False):
        axes.plot(
            x[filled == is_filled], y[filled == is_filled], ls="none", marker=line.marker, ms=5, mec=line.colour,
            mfc=line.colour if is_filled else "white", zorder=zorder,
        )  # fmt: skip


# -- what a figure shows of probe results ------------------------------------------------------------------------


def known_view(results: ProbeResults, view: str | None) -> str:
    """`view`, or the first probed one. Raises UnknownSiteError if it was not probed."""
    probed = results.settings.views
    view = view or probed[0]
    if view not in probed:
        raise UnknownSiteError(f"view {view!r} was not probed; probed: {', '.join(probed)}")
    return view


def curve_of(results: ProbeResults, category: str, view: str) -> ProbeCurve:
    """The probes of a category. Raises UnknownCategoryError if it was not probed."""
    if (category, view) not in results.curves:
        probed = ", ".join(results.settings.categories)
        raise UnknownCategoryError(f"category {category!r} was not probed; probed: {probed}")
    return results.curves[category, view]


def probed_curve(results: ProbeResults, view: str | None, category: str | None) -> tuple[str, str, ProbeCurve]:
    """Return category, view and curve, by default the first. Raises as `known_view` and `curve_of`."""
    view, category = known_view(results, view), category or results.settings.categories[0]
    return category, view, curve_of(results, category, view)


def scores_of(results: ProbeResults, category: str, view: str, stream: str | None = None) -> "pd.DataFrame":
    """Rows of `results.scores` of one category in one view, and of one stream where it is named."""
    scores = results.scores
    selected = (scores["category"] == category) & (scores["view"] == view)
    return scores[selected if stream is None else selected & (scores["stream"] == stream)]


def of_iterations(scores: "pd.DataFrame", iterations: Iterations) -> "pd.DataFrame":
    """The rows of one stream that take part; all of a stream that runs once.

    Raises UsageError if the stream has no such iteration.
    """
    steps = scores["iteration"].dropna()
    if iterations in ("all", "best") or steps.empty:
        return scores
    step = int(steps.max()) if iterations == "last" else iterations
    if not (steps == step).any():
        stream = scores["stream"].iloc[0]
        raise UsageError(f"the stream {stream} has iterations {steps.min()} to {steps.max()}, not {step}")
    return scores[scores["iteration"] == step]


def best_of(iterations: Iterations) -> Iterations:
    """Return the choice for what has one line or one number: the best iteration in place of all."""
    return "best" if iterations == "all" else iterations


def best_row(curve: ProbeCurve, stream: str) -> int:
    """Return the position of the site of a stream that has the largest score above its own chance.

    Raises UnknownSiteError without any.
    """
    rows = curve.stream(stream)
    if not rows.size:
        raise UnknownSiteError(
            f"stream {stream!r} was not probed in this view; probed: {', '.join(curve.streams)}"
        )
    return curve.largest_excess(rows)
