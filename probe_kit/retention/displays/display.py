"""The displays' base: a panel with legend and caption, several in one figure, and the choice of what they show."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UnknownCategoryError, UnknownSiteError, UsageError
from probe_kit.retention.choices import Iterations
from probe_kit.retention.displays.style import (
    Line,
    ProvenanceLine,
    axes_for,
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


class Display:
    """A display that has been plotted shows its figure; `ax_` is what `plot` drew on."""

    ax_: "Axes | None" = None

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


class Panelled(Display, ABC):
    """One panel, such as a stream of the model: on axes of its own, or beside others in one figure."""

    certificate: ProvenanceLine
    title_size = 9

    @property
    @abstractmethod
    def measure(self) -> str:
        """Return the name of the upright axis."""

    @property
    @abstractmethod
    def title(self) -> str:
        """Above the panel."""

    @abstractmethod
    def draw(self, axes: "Axes") -> None:
        """Draw marks with labels for the legend, and the axes' scales."""

    def further_handles(self) -> "Sequence[Artist]":
        """Return handles of the legend, behind those of what is drawn."""
        return []

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        axes, figure = axes_for(ax, 6.2, 3.9)
        self.draw(axes)
        plain(axes)
        axes.set_title(self.title, fontsize=self.title_size, loc="left")
        if figure is not None:
            axes.set_ylabel(self.measure, fontsize=9)
            _draw_legend(figure, [axes], self)
        caption(figure, self.certificate)
        self.ax_ = axes
        return self


def in_panels(
    displays: Sequence[Panelled],
    width: float = 3.1,
    height: float = 2.5,
    *,
    share: bool = True,
    level: bool = False,
) -> "Figure":
    """Return all of them in one figure, under one legend.

    displays: at least one, all of a kind. width, height: of a panel in inches. share: whether panels share both
    axes; level: whether they share the range of the upright one.
    """
    figure, grid = panels(len(displays), width, height, share=share)
    for display, axes in zip(displays, grid, strict=True):
        display.plot(axes)
    if level:
        ranges = [axes.get_ylim() for axes in grid]
        for axes in grid:
            axes.set_ylim(min(low for low, _ in ranges), max(high for _, high in ranges))
    figure.supylabel(displays[0].measure, fontsize=9)
    caption(figure, displays[0].certificate)
    _draw_legend(figure, grid, displays[0])
    return figure


def in_streams(
    read: Callable[[ProbeResults, str, str, str], Panelled],
    results: ProbeResults,
    view: str | None,
    category: str | None,
    width: float,
    height: float,
    *,
    level: bool = False,
) -> "Figure":
    """Return a panel per stream that was probed in a view and category, by default the first ones.

    read: makes a display of results, stream, view and category. Others: as in `in_panels`.
    """
    category, view, curve = probed_curve(results, view, category)
    displays = [read(results, stream, view, category) for stream in curve.streams]
    return in_panels(displays, width, height, share=False, level=level)


def _draw_legend(figure: "Figure", grid: "Sequence[Axes]", display: Panelled) -> None:
    """Draw a legend with every name once."""
    if every := [*legend_handles(*grid).values(), *display.further_handles()]:
        legend_above(figure, every)


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


def scores_of(results: ProbeResults, category: str, view: str) -> "pd.DataFrame":
    """Rows of `results.scores` of one category in one view."""
    scores = results.scores
    return scores[(scores["category"] == category) & (scores["view"] == view)]


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
