"""The parts that figures of a label share: a panel per stream of the model, and the site of a panel."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UnknownSiteError
from probe_kit.retention.displays.base.display import Display
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.style import axes_for, caption, legend_above, panels, plain
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BACKGROUND = "0.92"
"""Colour of the band of permuted labels."""


class LabelPanel(Display):
    """One stream of one label in one view. size: of a panel in inches."""

    size: ClassVar[tuple[float, float]] = (3.1, 2.6)
    certificate: ProvenanceLine
    ax_: "Axes | None"

    @property
    @abstractmethod
    def title(self) -> str:
        """Above the panel."""

    @property
    @abstractmethod
    def measure(self) -> str:
        """Return the name of the upright axis."""

    @abstractmethod
    def draw(self, axes: "Axes") -> None:
        """Marks with labels for the legend, and the axes' scales."""

    def further_handles(self) -> "list[Artist]":
        """Return handles of the legend, behind those of what is drawn."""
        return []

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        axes, figure = axes_for(ax, 5.6, 4.0)
        self.draw(axes)
        plain(axes)
        axes.set_title(self.title, fontsize=9, loc="left")
        if figure is not None:
            axes.set_ylabel(self.measure, fontsize=9)
            _draw_legend(figure, [axes], self)
        caption(figure, self.certificate)
        self.ax_ = axes
        return self


def label_panels(displays: Sequence[LabelPanel], level: bool = False) -> "Figure":
    """All streams in one figure, under one legend. level: whether panels share the range of the upright axis."""
    width, height = displays[0].size
    figure, grid = panels(len(displays), width, height, share=False)
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


def _draw_legend(figure: "Figure", grid: "Sequence[Axes]", display: LabelPanel) -> None:
    """Every name once."""
    handles: dict[str, Artist] = {}
    for axes in grid:
        handles |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if every := [*handles.values(), *display.further_handles()]:
        legend_above(figure, every)


def label_curve_of(results: ProbeResults, view: str | None, category: str | None) -> tuple[str, str, ProbeCurve]:
    """Return category, view and curve, by default the first. Raises UnknownSiteError for others."""
    settings = results.settings
    view, category = view or settings.views[0], category or settings.categories[0]
    if (category, view) not in results.curves:
        raise UnknownSiteError(
            f"view {view!r}, category {category!r} was not probed; probed: {', '.join(settings.views)} of "
            f"{', '.join(settings.categories)}"
        )
    return category, view, results.curves[category, view]


def rows_of(curve: ProbeCurve, stream: str) -> NDArray[np.intp]:
    """Return the positions of the sites of a stream. Raises UnknownSiteError without any."""
    rows = curve.stream(stream)
    if not rows.size:
        raise UnknownSiteError(
            f"stream {stream!r} was not probed in this view; probed: {', '.join(curve.streams)}"
        )
    return rows


def best_row(curve: ProbeCurve, stream: str) -> int:
    """Return the position of the site of a stream that has the largest score above its own chance."""
    return curve.largest_excess(rows_of(curve, stream))
