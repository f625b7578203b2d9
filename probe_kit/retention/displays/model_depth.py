"""Several models on one axis: depth as a fraction makes 18 and 32 layers comparable."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.retention.displays.certificate import Certificate
from probe_kit.retention.displays.layer_curves import DEPTH
from probe_kit.retention.displays.selection import known_view, scores_of
from probe_kit.retention.displays.showing import Shown
from probe_kit.retention.displays.style import STREAM_NAMES, axes_for, caption, plain, series
from probe_kit.train.results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class ModelCurve:
    """Accuracy above chance by depth, (L,) each, averaged over categories."""

    model: str
    depth: NDArray[np.float64]
    above_chance: NDArray[np.float64]
    categories: int


@dataclass
class ModelDepthDisplay(Shown):
    """Held-out accuracy above chance against depth, averaged over categories, one line per model.

    At each depth the best iteration counts, in each category by itself.
    """

    stream: str
    models: tuple[ModelCurve, ...]
    certificates: tuple[Certificate, ...]
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_results(
        cls, results: Sequence[ProbeResults], stream: str = "backbone", view: str | None = None
    ) -> Self:
        """From the stored probes of several runs; view: the first probed one of each by default.

        Raises UnknownSiteError for a view that was not probed, UsageError if no run has that stream.
        """
        found = [(one, known_view(one, view)) for one in results]
        kept = [(one, shown) for one, shown in found if (one.scores["stream"] == stream).any()]
        if not kept:
            raise UsageError(f"none of the {len(results)} runs has probes of stream {stream!r}")
        return cls(
            stream=stream,
            models=tuple(_curve(one, stream, shown) for one, shown in kept),
            certificates=tuple(Certificate.of_results(one, shown) for one, shown in kept),
        )

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and captions."""
        axes, figure = axes_for(ax, 6.2, 3.9)
        axes.axhline(0, color="0.45", lw=1, ls=(0, (1, 1)))
        for position, model in enumerate(self.models):
            line = series(position)
            axes.plot(
                model.depth, 100 * model.above_chance, color=line.colour, ls=line.dash, lw=1.4, marker=line.marker,
                ms=4.5, mfc="white", label=model.model,
            )  # fmt: skip
        plain(axes)
        axes.set_xlim(-0.04, 1.04)
        axes.set_xticks([0, 0.25, 0.5, 0.75, 1], ["0", "0.25", "0.5", "0.75", "1"])
        axes.set_title(STREAM_NAMES.get(self.stream, self.stream), fontsize=10, loc="left")
        if figure is not None:
            axes.set_ylabel("accuracy above chance\n(points, mean of categories)", fontsize=9)
            axes.legend(fontsize=8, frameon=False)
        caption(figure, *(certificate.line for certificate in self.certificates), label=DEPTH)
        self.ax_ = axes
        return self


def model_depths(results: Sequence[ProbeResults], view: str | None = None) -> "Figure":
    """Backbones side by side, and action experts, on one scale. Raises UsageError if no run has either."""
    from probe_kit.retention.displays.shown_figure import ShownFigure

    streams = [name for name in STREAM_NAMES if any((one.scores["stream"] == name).any() for one in results)]
    displays = [ModelDepthDisplay.from_results(results, stream, view) for stream in streams]
    if not displays:
        raise UsageError("no run has probes of a backbone or an action expert")
    figure = ShownFigure(figsize=(4.1 * max(len(displays), 1.5), 3.6), layout="constrained", dpi=150)
    grid = figure.subplots(1, len(displays), sharey=True, squeeze=False)[0]
    for display, axes in zip(displays, grid, strict=True):
        display.plot(axes)
    grid[0].legend(fontsize=8, frameon=False)
    figure.supylabel("accuracy above chance (points, mean of categories)", fontsize=8)
    lines = (certificate.line for display in displays for certificate in display.certificates)
    caption(figure, *lines, label=DEPTH)
    return figure


def _curve(results: ProbeResults, stream: str, view: str) -> ModelCurve:
    curves = []
    for category in results.settings.categories:
        scores = scores_of(results, category, view)
        scores = scores[scores["stream"] == stream]
        if not scores.empty:
            curves.append(scores.groupby("depth")["accuracy"].max() - scores["chance"].iloc[0])
    depth = curves[0].index.to_numpy(dtype=float)
    name = results.settings.model + (" (random weights)" if results.settings.random_weights else "")
    return ModelCurve(name, depth, np.mean([curve.to_numpy(dtype=float) for curve in curves], axis=0), len(curves))
