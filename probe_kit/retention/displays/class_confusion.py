"""Confusion matrix of a label of classes: which class the best site predicts for which."""

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
from probe_kit.retention.displays.base.style import BLUE
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WITH_NUMBERS = 12
"""Classes, more than which leave no room for numbers in the cells."""
_LONGEST = 14
"""Letters of a class that are shown."""


@dataclass
class ClassConfusionDisplay(Panelled):
    """Held-out predictions of the best site of a stream.

    counts: (K, K) samples by true class, down, and predicted class, across. site: of the largest score above its
    own chance.
    """

    target: str
    view: str
    stream: str
    site: str
    classes: tuple[str, ...]
    counts: NDArray[np.int64]
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
        """Read stored probes of a binary label or of classes; view, category: the first probed one by default.

        Raises UnknownSiteError for a view or stream that was not probed, UsageError for a continuous label.
        """
        from sklearn.metrics import confusion_matrix

        category, view, curve = probed_curve(results, view, category)
        if not curve.classes:
            raise UsageError(f"the label {results.settings.target!r} is continuous; expected classes to confuse")
        row = best_row(curve, stream)
        classes = np.arange(len(curve.classes))
        return cls(
            target=results.settings.target,
            view=view,
            stream=stream,
            site=str(curve.sites[row]),
            classes=curve.classes,
            counts=confusion_matrix(curve.labels, curve.decisions[row], labels=classes),
            certificate=ProvenanceLine.of_label(results, category, view),
        )

    @property
    def shares(self) -> NDArray[np.float64]:
        """(K, K) of each true class; the mean of the diagonal is the balanced accuracy."""
        shares: NDArray[np.float64] = self.counts / self.counts.sum(axis=1, keepdims=True).clip(1)
        return shares

    @property
    def title(self) -> str:
        """The site."""
        return self.site

    @property
    def measure(self) -> str:
        """Rows."""
        return "true class (samples)"

    def draw(self, axes: "Axes") -> None:
        """Shares of the true class as colours, and in percent."""
        from matplotlib.colors import LinearSegmentedColormap

        shares, places = self.shares, range(len(self.classes))
        axes.imshow(
            shares,
            vmin=0,
            vmax=1,
            cmap=LinearSegmentedColormap.from_list("shares", ["white", BLUE]),
            aspect="auto",
        )
        names = [name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}…" for name in self.classes]
        counts = self.counts.sum(axis=1)
        axes.set_xticks(places, names, rotation=35, ha="right", rotation_mode="anchor")
        axes.set_yticks(places, [f"{name} ({count})" for name, count in zip(names, counts, strict=True)])
        axes.set_xlabel("predicted class, % of the true class", fontsize=8.5)
        axes.tick_params(length=0)
        for down in places if len(places) <= _WITH_NUMBERS else ():
            for across in places:
                ink = "white" if shares[down, across] > 0.6 else "black"
                axes.text(
                    across,
                    down,
                    f"{100 * shares[down, across]:.0f}",
                    ha="center",
                    va="center",
                    fontsize=8,
                    color=ink,
                )


def class_confusions(results: ProbeResults, view: str | None = None, category: str | None = None) -> "Figure":
    """Confusion matrices, a panel per stream; arguments and errors as of `ClassConfusionDisplay`."""
    return in_streams(ClassConfusionDisplay.from_results, results, view, category, 3.3, 3.1)


PLACE = 17
"""Of its figures in the report."""


def label_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield the figures that a report of these labels shows: of those with classes."""
    for view in label_views(source):
        if view.curve.classes:
            yield view.figure(
                "confusion", "Confusion matrix",
                "Which class the best site of each part predicts for which, in groups it has not seen. Each row "
                "sums to 100 %; the mean of the diagonal is the balanced accuracy.",
                partial(class_confusions, view.results, view.name, view.category),
            )  # fmt: skip
