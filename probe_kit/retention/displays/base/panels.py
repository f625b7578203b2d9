"""Displays that are one panel: on axes of their own with legend and caption, or side by side in one figure."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Self

from probe_kit.retention.displays.base.display import Display
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.selection import probed_curve
from probe_kit.retention.displays.base.style import (
    Line,
    axes_for,
    caption,
    legend_above,
    legend_handles,
    panels,
    plain,
)
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray


class Panelled(Display, ABC):
    """One panel, such as a stream of the model."""

    certificate: ProvenanceLine
    ax_: "Axes | None"

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

    def further_handles(self) -> "list[Artist]":
        """Return handles of the legend, behind those of what is drawn."""
        return []

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        axes, figure = axes_for(ax, 6.2, 3.9)
        self.draw(axes)
        plain(axes)
        axes.set_title(self.title, fontsize=9, loc="left")
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
    x: "NDArray[np.float64]",
    y: "NDArray[np.float64]",
    filled: "NDArray[np.bool_]",
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
