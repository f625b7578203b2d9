"""Layer curve of a label: score by layer, with the band of permuted labels and the best control."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.selection import scores_of
from probe_kit.retention.displays.base.style import PARTS, layer_axis, significance_handles
from probe_kit.retention.displays.labels.label_panel import (
    BACKGROUND,
    LabelPanel,
    label_curve_of,
    label_panels,
    rows_of,
)
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ENOUGH = 20  # label permutations, fewer than which have no 95 % band
Values = NDArray[np.float64]


@dataclass
class LabelCurveDisplay(LabelPanel):
    """Score of a label by layer in one stream; arrays (L,).

    A layer with several sites, such as iterations, shows the one of the largest score above its own chance;
    iterations: (L,) which, -1 where the stream runs once. low, high: 95 % interval over groups, NaN for a site
    that was chosen. chance: mean score of the label permutations at the site; null_low, null_high: 95 % of them,
    NaN below 20 permutations. signal: p_fwe < 0.05, and the site exceeds every control that was run. control: name
    and score of the best control, None without any. several: how many sites a layer has at most.
    """

    size: ClassVar[tuple[float, float]] = (3.3, 2.7)

    target: str
    metric: str
    view: str
    stream: str
    part: str
    layers: NDArray[np.int64]
    iterations: NDArray[np.int64]
    score: Values
    low: Values
    high: Values
    chance: Values
    null_low: Values
    null_high: Values
    signal: NDArray[np.bool_]
    control: tuple[str, float] | None
    several: int
    certificate: ProvenanceLine
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_results(
        cls,
        results: ProbeResults,
        stream: str = "backbone",
        view: str | None = None,
        category: str | None = None,
    ) -> Self:
        """Read stored probes; view, category: by default the first. Raises UnknownSiteError for others."""
        category, view, curve = label_curve_of(results, view, category)
        rows = rows_of(curve, stream)
        layers = np.array([curve.sites[row].layer for row in rows])
        numbers = np.unique(layers)
        best = np.array([curve.largest_excess(rows[layers == layer]) for layer in numbers])
        several = int(max((layers == layer).sum() for layer in numbers))
        table = scores_of(results, category, view).set_index("site")
        best_rows = table.loc[[str(curve.sites[row]) for row in best]]
        limits = best_rows[["ci_low", "ci_high"]].to_numpy(dtype=float).T
        null = curve.null[best]
        band = np.full((2, best.size), np.nan)
        if null.shape[1] >= _ENOUGH:
            band = np.percentile(null, [2.5, 97.5], axis=1)
        controls = results.controls.of_stream(category, view, stream)
        iterations = [curve.sites[row].iteration for row in best]
        return cls(
            target=results.settings.target,
            metric=METRICS[results.settings.task],
            view=view,
            stream=stream,
            part=curve.parts[rows[0]],
            layers=numbers,
            iterations=np.array([-1 if step is None else step for step in iterations]),
            score=curve.metric[best],
            low=limits[0] if several == 1 else np.full(best.size, np.nan),
            high=limits[1] if several == 1 else np.full(best.size, np.nan),
            chance=curve.chance[best],
            null_low=band[0],
            null_high=band[1],
            signal=best_rows["signal"].to_numpy(dtype=bool),
            control=(controls[0].name, controls[0].score) if controls else None,
            several=several,
            certificate=ProvenanceLine.of_label(results, category, view),
        )

    @property
    def title(self) -> str:
        """The stream."""
        return label_of(self.stream)

    @property
    def measure(self) -> str:
        """The metric."""
        return f"held-out {self.metric}"

    def further_handles(self) -> "list[Artist]":
        """Return the handles of filled and open markers."""
        return list(significance_handles())

    def draw(self, axes: "Axes") -> None:
        """Band, chance, controls and scores."""
        self._draw_ground(axes)
        line = PARTS[self.part]
        if self.several == 1:
            arms = np.array([self.score - self.low, self.high - self.score]).clip(min=0)
            axes.errorbar(
                self.layers, self.score, yerr=arms, fmt="none", ecolor=line.colour, elinewidth=0.8, alpha=0.7
            )
        axes.plot(
            self.layers, self.score, color=line.colour, lw=1.3, ls=line.dash, marker=line.marker, ms=4.5,
            mfc="white", label=label_of(self.stream),
        )  # fmt: skip
        has_signal = self.signal
        axes.plot(
            self.layers[has_signal],
            self.score[has_signal],
            color=line.colour,
            ls="none",
            marker=line.marker,
            ms=4.5,
        )
        layer_axis(axes, int(self.layers.max()) + 1)
        if self.several > 1:
            axes.set_xlabel("layer, at its best site", fontsize=8.5)
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, 0.0), max(high, 1.05))

    def _draw_ground(self, axes: "Axes") -> None:
        """Draw chance and controls; of a single layer as wide as a step between layers."""
        wide = self.layers if self.layers.size > 1 else self.layers + np.array([-0.3, 0.3])
        band = [np.broadcast_to(edge, wide.shape) for edge in (self.null_low, self.null_high, self.chance)]
        if not np.isnan(self.null_low).any():
            axes.fill_between(wide, band[0], band[1], color=BACKGROUND, lw=0, label="95 % of permuted labels")
        if not np.isnan(self.chance).any():
            axes.plot(wide, band[2], color="0.45", lw=1, ls="--", label="chance of the site")
        if self.control is not None:
            name, score = self.control
            axes.axhline(score, color="black", lw=1, ls=":", label="best control")
            axes.set_title(f"control {name} {score:.2f}", fontsize=7, loc="right", color="0.2")


def label_curves(results: ProbeResults, view: str | None = None, category: str | None = None) -> "Figure":
    """Score of a label by layer, a panel per stream; arguments and errors as of `LabelCurveDisplay`."""
    category, view, curve = label_curve_of(results, view, category)
    displays = [LabelCurveDisplay.from_results(results, stream, view, category) for stream in curve.streams]
    return label_panels(displays, level=True)
