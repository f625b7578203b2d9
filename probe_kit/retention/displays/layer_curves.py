"""Layer curves: accuracy against depth, backbone beside action expert."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.retention.displays.certificate import Certificate
from probe_kit.retention.displays.selection import curve_of, known_view, scores_of
from probe_kit.retention.displays.showing import Shown
from probe_kit.retention.displays.style import (
    OTHER_STREAM,
    STREAM_NAMES,
    STREAMS,
    Line,
    axes_for,
    caption,
    panels,
    plain,
    spell,
)
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.train.results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

DEPTH = "depth (0 enters the first block, 1 leaves the last)"
_SIDESTEP = 0.006  # in depth, so that the two streams' bars do not hide each other

_ENOUGH = 20  # relabellings, fewer than which have no 95 % band

Shares = NDArray[np.float64]


@dataclass(frozen=True)
class StreamCurve:
    """One stream's held-out accuracy by layer; arrays (L,), accuracies as shares. depth: the layer as a fraction.

    accuracy: of the best iteration where there are several, with its 95 % interval `low`, `high` over groups.
    least, most: over all iterations. significant: above chance, family-wise. iterations: how many there are.
    """

    stream: str
    layers: NDArray[np.int64]
    depth: Shares
    accuracy: Shares
    low: Shares
    high: Shares
    least: Shares
    most: Shares
    significant: NDArray[np.bool_]
    iterations: int

    @classmethod
    def of(cls, scores: "pd.DataFrame") -> Self:
        """From the rows of one category, view and stream of `ProbeResults.scores`."""
        by_depth = scores.groupby("depth")["accuracy"]
        best = scores.loc[by_depth.idxmax()].sort_values("depth")
        depth, accuracy, low, high = (
            best[name].to_numpy(dtype=float) for name in ("depth", "accuracy", "ci_low", "ci_high")
        )
        return cls(
            stream=str(best["stream"].iloc[0]),
            layers=best["layer"].to_numpy(dtype=np.int64),
            depth=depth,
            accuracy=accuracy,
            low=low,
            high=high,
            least=by_depth.min().to_numpy(dtype=float),
            most=by_depth.max().to_numpy(dtype=float),
            significant=best["signal"].to_numpy(dtype=bool),
            iterations=int(scores["iteration"].nunique()) or 1,
        )


@dataclass
class LayerCurveDisplay(Shown):
    """Held-out accuracy against depth, for one category in one view.

    Filled markers are above chance against the best site of their stream (family-wise p < 0.05), and above binding
    and twin where those were run. Grey: chance, and `null_band`, which holds 95 % of the accuracies under
    relabelling; None below 20 relabellings.
    """

    category: str
    view: str
    chance: float
    null_band: tuple[float, float] | None
    streams: tuple[StreamCurve, ...]
    certificate: Certificate
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_results(cls, results: ProbeResults, category: str, view: str | None = None) -> Self:
        """From stored probes; view: the first probed one by default.

        Raises UnknownSiteError for a view, and UnknownCategoryError for a category, that was not probed.
        """
        view = known_view(results, view)
        curve = curve_of(results, category, view)
        band = np.percentile(curve.null, [2.5, 97.5]) if curve.null.shape[1] >= _ENOUGH else None
        scores = scores_of(results, category, view)
        return cls(
            category=category,
            view=view,
            chance=curve.chance,
            null_band=None if band is None else (float(band[0]), float(band[1])),
            streams=tuple(StreamCurve.of(rows) for _, rows in scores.groupby("stream", sort=False)),
            certificate=Certificate.of_results(results, view),
        )

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and caption."""
        axes, figure = axes_for(ax, 6.2, 3.9)
        if self.null_band is not None:
            low, high = self.null_band
            axes.axhspan(100 * low, 100 * high, color="0.92", lw=0, label="95 % of relabelled probes")
        axes.axhline(100 * self.chance, color="0.45", lw=1, ls="--", label="chance")
        for curve in self.streams:
            _draw_stream(axes, curve)
        plain(axes)
        axes.set_xlim(-0.04, 1.04)
        axes.set_xticks([0, 0.25, 0.5, 0.75, 1], ["0", "0.25", "0.5", "0.75", "1"])
        axes.set_title(spell(self.category), fontsize=10, loc="left")
        if figure is not None:
            axes.set_ylabel(f"held-out accuracy (%), view {self.view}", fontsize=9)
            _draw_legend(figure, axes)
        caption(figure, self.certificate.line, label=DEPTH)
        self.ax_ = axes
        return self


def layer_curve(results: ProbeResults, view: str | None = None) -> "Figure":
    """Held-out accuracy against depth for every category, as a matplotlib figure (`figure.savefig(…)`).

    Lines: backbone, and the expert's best iteration with a band over all its iterations; bars: 95 % intervals
    over groups. Filled markers are above chance against the best site of their stream (family-wise p < 0.05),
    and above binding and twin where those were run.
    Grey: chance, and the band that holds 95 % of the accuracies under relabelling. view: the first probed one
    by default. Raises UnknownSiteError for a view that was not probed.
    """
    view = known_view(results, view)
    displays = [LayerCurveDisplay.from_results(results, name, view) for name in results.settings.categories]
    figure, grid = panels(len(displays))
    for display, axes in zip(displays, grid, strict=True):
        display.plot(axes)
    figure.supylabel(f"held-out accuracy (%), view {view}", fontsize=9)
    caption(figure, displays[0].certificate.line, label=DEPTH)
    _draw_legend(figure, grid[0])
    return figure


def _draw_stream(axes: "Axes", curve: StreamCurve) -> None:
    line = STREAMS.get(curve.stream, OTHER_STREAM)
    name = STREAM_NAMES.get(curve.stream, curve.stream)
    sidestep = {"backbone": -_SIDESTEP, "expert": _SIDESTEP, "action": _SIDESTEP}.get(curve.stream, 0.0)
    if curve.iterations > 1:
        band = 100 * curve.least, 100 * curve.most
        axes.fill_between(curve.depth, *band, color=line.colour, alpha=0.15, lw=0, label=f"{name}, all iterations")
        name = f"{name}, best iteration"
    draw_curve(axes, curve, line, name, sidestep)


def draw_curve(axes: "Axes", curve: StreamCurve, line: Line, name: str, sidestep: float = 0.0) -> None:
    """One stream's line with intervals; filled markers where it is significant."""
    depth, accuracy = curve.depth + sidestep, 100 * curve.accuracy
    bars = [accuracy - 100 * curve.low, 100 * curve.high - accuracy]
    axes.errorbar(depth, accuracy, yerr=bars, fmt="none", ecolor=line.colour, elinewidth=0.7, alpha=0.6)
    axes.plot(
        depth,
        accuracy,
        color=line.colour,
        lw=1.3,
        ls=line.dash,
        marker=line.marker,
        ms=4.5,
        mfc="white",
        label=name,
    )
    clear = curve.significant
    axes.plot(depth[clear], accuracy[clear], color=line.colour, ls="none", marker=line.marker, ms=4.5)


def _draw_legend(figure: "Figure", panel: "Axes") -> None:
    handles, labels = panel.get_legend_handles_labels()
    filled = filled_marker()
    handles.append(filled)
    labels.append(str(filled.get_label()))
    figure.legend(handles, labels, loc="outside upper left", ncols=2, fontsize=8, frameon=False)


def filled_marker() -> "Line2D":
    """The legend's entry for filled markers."""
    from matplotlib.lines import Line2D

    label = f"filled: above chance, family-wise p < {SIGNIFICANCE}"
    return Line2D([], [], color="0.3", ls="none", marker="o", ms=4.5, label=label)
