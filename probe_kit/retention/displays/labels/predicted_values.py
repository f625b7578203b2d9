"""Predicted against true values of a continuous label."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.labels.label_panel import (
    LabelPanel,
    best_row,
    label_curve_of,
    label_panels,
)
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PIXELS_FROM = 2000
"""Points, from which on a figure holds them as pixels."""


@dataclass
class PredictedValuesDisplay(LabelPanel):
    """Held-out predictions of the best site of a stream; arrays (n,).

    true, predicted: values in the label's own unit. groups: (n,) number of each sample's group, which is its
    colour. site: of the largest score above its own chance. score: its R².
    """

    size: ClassVar[tuple[float, float]] = (3.3, 3.0)

    target: str
    view: str
    stream: str
    site: str
    score: float
    true: NDArray[np.float64]
    predicted: NDArray[np.float64]
    groups: NDArray[np.int64]
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
        """Read stored probes of a continuous label; view, category: the first probed one by default.

        Raises UnknownSiteError for a view or stream that was not probed, UsageError for a label of classes.
        """
        category, view, curve = label_curve_of(results, view, category)
        if results.settings.task != "continuous":
            raise UsageError(f"the label {results.settings.target!r} is of classes; expected a continuous one")
        row = best_row(curve, stream)
        return cls(
            target=results.settings.target,
            view=view,
            stream=stream,
            site=str(curve.sites[row]),
            score=float(curve.metric[row]),
            true=curve.labels,
            predicted=curve.decisions[row],
            groups=np.unique(curve.groups, return_inverse=True)[1].astype(np.int64),
            certificate=ProvenanceLine.of_label(results, category, view),
        )

    @property
    def title(self) -> str:
        """Site and score."""
        return f"{self.site}, {METRICS['continuous']} {self.score:.2f}"

    @property
    def measure(self) -> str:
        """The prediction."""
        return "predicted value"

    def draw(self, axes: "Axes") -> None:
        """A point per sample, and where prediction and label are equal."""
        low = float(min(self.true.min(), self.predicted.min()))
        high = float(max(self.true.max(), self.predicted.max()))
        axes.plot([low, high], [low, high], color="0.6", lw=0.9, ls="--", label="predicted = true")
        axes.scatter(
            self.true, self.predicted, c=self.groups, cmap="turbo", s=9, alpha=0.6, lw=0,
            rasterized=self.true.size > _PIXELS_FROM, label="a sample; its colour is its group",
        )  # fmt: skip
        axes.set_xlabel("true value", fontsize=8.5)


def predicted_values(results: ProbeResults, view: str | None = None, category: str | None = None) -> "Figure":
    """Predicted against true, a panel per stream; arguments and errors as of `PredictedValuesDisplay`."""
    category, view, curve = label_curve_of(results, view, category)
    displays = [PredictedValuesDisplay.from_results(results, stream, view, category) for stream in curve.streams]
    return label_panels(displays, level=True)
