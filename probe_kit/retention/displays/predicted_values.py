"""Predicted against true values of a continuous label."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.retention.displays.base.panels import Panelled, in_streams
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import FigureSource, ReportFigure, label_views
from probe_kit.retention.displays.base.selection import best_row, probed_curve
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PIXELS_FROM = 2000
"""Points, from which on a figure holds them as pixels."""


@dataclass
class PredictedValuesDisplay(Panelled):
    """Held-out predictions of the best site of a stream; arrays (n,).

    true, predicted: values in the label's own unit. groups: (n,) number of each sample's group, which is its
    colour. site: of the largest score above its own chance. score: its R².
    """

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
        category, view, curve = probed_curve(results, view, category)
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
    return in_streams(PredictedValuesDisplay.from_results, results, view, category, 3.3, 3.0, level=True)


PLACE = 18
"""Of its figures in the report."""


def label_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield the figures that a report of these labels shows: of continuous ones."""
    for view in label_views(source):
        if not view.curve.classes:
            yield view.figure(
                "predicted", "Predicted against true",
                "A point per sample, predicted by the best site of each part in groups it has not seen. Colours "
                "are groups. Predictions are clipped to the range of the training labels.",
                partial(predicted_values, view.results, view.name, view.category),
            )  # fmt: skip
