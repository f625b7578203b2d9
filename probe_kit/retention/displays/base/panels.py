"""Displays that are one panel: on axes of their own with legend and caption, or side by side in one figure."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Self

from probe_kit.retention.displays.base.display import Display
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.style import Line, axes_for, caption, legend_above, panels, plain

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray


class Panelled(Display, ABC):
    """One panel. measure: what its upright axis counts. title: what it is of."""

    measure: ClassVar[str]
    certificate: ProvenanceLine
    ax_: "Axes | None"

    @property
    @abstractmethod
    def title(self) -> str:
        """Above the panel."""

    @abstractmethod
    def draw(self, axes: "Axes") -> None:
        """Lines, with labels for the legend, and the axes' scales."""

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        axes, figure = axes_for(ax, 6.2, 3.9)
        self.draw(axes)
        plain(axes)
        axes.set_title(self.title, fontsize=10, loc="left")
        if figure is not None:
            axes.set_ylabel(self.measure, fontsize=9)
            legend_above(figure, axes.get_legend_handles_labels()[0])
        caption(figure, self.certificate)
        self.ax_ = axes
        return self


def in_panels(displays: Sequence[Panelled], height: float = 2.5, *, share: bool = True) -> "Figure":
    """All of them in one figure, under one legend. displays: at least one, all of a kind."""
    figure, grid = panels(len(displays), height=height, share=share)
    for display, axes in zip(displays, grid, strict=True):
        display.plot(axes)
    figure.supylabel(displays[0].measure, fontsize=9)
    caption(figure, displays[0].certificate)
    legend_above(figure, grid[0].get_legend_handles_labels()[0])
    return figure


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
