"""Figures of labels: classes that are confused, predicted against true values, and scores by step."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.retention.displays.display import Panelled, best_row, in_streams, probed_curve, scores_of
from probe_kit.retention.displays.report_figure import FigureSource, ReportFigure, in_report, label_views
from probe_kit.retention.displays.style import BLUE, GREEN, PARTS, Line, ProvenanceLine, significance_handles
from probe_kit.retention.rows.probe_parts import STEP
from probe_kit.train.crossval.task_scores import METRICS, score_interval
from probe_kit.train.results.control_scores import ControlScore
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass
class BestSiteDisplay(Panelled):
    """A panel of a label's probes at the best site of a stream: that of the largest score above its own chance."""

    target: str
    view: str
    stream: str
    site: str
    certificate: ProvenanceLine

    @property
    def title(self) -> str:
        """The site."""
        return self.site


def _site_fields(results: ProbeResults, category: str, view: str, stream: str, row: int) -> dict[str, Any]:
    """Return the fields of `BestSiteDisplay` of the site at `row` of a curve."""
    return {
        "target": results.settings.target,
        "view": view,
        "stream": stream,
        "site": str(results.curves[category, view].sites[row]),
        "certificate": ProvenanceLine.of_results(results, view, category),
    }


# -- confusion of classes ------------------------------------------------------------------------------------

_WITH_NUMBERS = 12
"""Classes, more than which leave no room for numbers in the cells."""
_LONGEST = 14
"""Letters of a class that are shown."""


@dataclass
class ClassConfusionDisplay(BestSiteDisplay):
    """Held-out predictions of the best site of a stream, the one farthest above its own chance.

    counts: (K, K) samples by true class, down, and predicted class, across.
    """

    classes: tuple[str, ...]
    counts: NDArray[np.int64]

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
            **_site_fields(results, category, view, stream, row),
            classes=curve.classes,
            counts=confusion_matrix(curve.labels, curve.decisions[row], labels=classes),
        )

    @property
    def shares(self) -> NDArray[np.float64]:
        """(K, K) of each true class; the mean of the diagonal is the balanced accuracy."""
        shares: NDArray[np.float64] = self.counts / self.counts.sum(axis=1, keepdims=True).clip(1)
        return shares

    @property
    def measure(self) -> str:
        """Rows."""
        return "true class (samples)"

    def draw(self, axes: "Axes") -> None:
        """Shares of the true class as colours, and in percent."""
        from matplotlib.colors import LinearSegmentedColormap

        shares, places = self.shares, range(len(self.classes))
        colours = LinearSegmentedColormap.from_list("shares", ["white", BLUE])
        axes.imshow(shares, vmin=0, vmax=1, cmap=colours, aspect="auto")
        names = [name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}…" for name in self.classes]
        counts = self.counts.sum(axis=1)
        axes.set_xticks(places, names, rotation=35, ha="right", rotation_mode="anchor")
        axes.set_yticks(places, [f"{name} ({count})" for name, count in zip(names, counts, strict=True)])
        axes.set_xlabel("predicted class, % of the true class", fontsize=8.5)
        axes.tick_params(length=0)
        for down in places if len(places) <= _WITH_NUMBERS else ():
            for across in places:
                ink = "white" if shares[down, across] > 0.6 else "black"
                percent = f"{100 * shares[down, across]:.0f}"
                axes.text(across, down, percent, ha="center", va="center", fontsize=8, color=ink)


def class_confusions(results: ProbeResults, view: str | None = None, category: str | None = None) -> "Figure":
    """Confusion matrices, a panel per stream; arguments and errors as of `ClassConfusionDisplay`."""
    return in_streams(ClassConfusionDisplay.from_results, results, view, category, 3.3, 3.1)


@in_report(17, "labels")
def confusion_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield the figures that a report of these labels shows: of those with classes."""
    for view in label_views(source):
        if view.curve.classes:
            yield view.figure(
                "confusion", "Confusion matrix",
                "Which class the best site of each part predicts for which, in groups it has not seen. Each row "
                "sums to 100 %; the mean of the diagonal is the balanced accuracy.",
                class_confusions,
            )  # fmt: skip


# -- predicted against true values ---------------------------------------------------------------------------

_PIXELS_FROM = 2000
"""Points, from which on a figure holds them as pixels."""


@dataclass
class PredictedValuesDisplay(BestSiteDisplay):
    """Held-out predictions of the best site of a stream, the one farthest above its own chance; arrays (n,).

    true, predicted: values in the label's own unit. groups: (n,) number of each sample's group, which is its
    colour. score: R² of the site.
    """

    score: float
    true: NDArray[np.float64]
    predicted: NDArray[np.float64]
    groups: NDArray[np.int64]

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
            **_site_fields(results, category, view, stream, row),
            score=float(curve.metric[row]),
            true=curve.labels,
            predicted=curve.decisions[row],
            groups=np.unique(curve.groups, return_inverse=True)[1].astype(np.int64),
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


@in_report(18, "labels")
def predicted_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield the figures that a report of these labels shows: of continuous ones."""
    for view in label_views(source):
        if not view.curve.classes:
            yield view.figure(
                "predicted", "Predicted against true",
                "A point per sample, predicted by the best site of each part in groups it has not seen. Colours "
                "are groups. Predictions are clipped to the range of the training labels.",
                predicted_values,
            )  # fmt: skip


# -- scores by step ------------------------------------------------------------------------------------------

_CONTROLS = (Line("black", "", ":"), Line(GREEN, "", (0, (5, 1))))  # type: ignore[arg-type]  # as `SERIES`


@dataclass
class StepScoresDisplay(BestSiteDisplay):
    """The metric at each step, of the site of a stream that is farthest above its own chance; arrays (W,).

    R² is that of the label's spread over all steps. Balanced accuracy is that of the classes at the
    step. steps: inferences, or places behind the event where windows begin. low, high: 95 % interval over groups.
    controls: by name, the metric of the best control and of `step`. signal: whether the site exceeds chance,
    family-wise, and every control that was run.
    """

    metric: str
    part: str
    signal: bool
    steps: NDArray[np.int64]
    from_event: bool
    score: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    controls: dict[str, NDArray[np.float64]]

    @classmethod
    def from_results(
        cls,
        results: ProbeResults,
        stream: str = "backbone",
        view: str | None = None,
        category: str | None = None,
    ) -> Self:
        """Read stored probes; view, category: the first probed one by default.

        Raises UnknownSiteError for a view or stream that was not probed, UsageError for labels of a single step.
        """
        category, view, curve = probed_curve(results, view, category)
        if curve.steps.size < 2:
            raise UsageError(f"the label {results.settings.target!r} has one step; expected several to show")
        row = best_row(curve, stream)
        settings, scores = results.settings, curve.scores[row]
        table = scores_of(results, category, view).set_index("site")
        balanced = curve.step_scores(scores)
        limits = [
            score_interval(balanced[at], curve.labels[at], curve.groups[at], settings.task, curve.deviations[at])
            for at in (curve.places == step for step in curve.steps)
        ]
        return cls(
            **_site_fields(results, category, view, stream, row),
            metric=METRICS[settings.task],
            part=curve.parts[row],
            signal=bool(table.loc[str(curve.sites[row]), "signal"]),
            steps=curve.steps,
            from_event=curve.aligned is not None,
            score=curve.by_step(scores),
            low=np.array([low for low, _ in limits]),
            high=np.array([high for _, high in limits]),
            controls={
                control.name: np.array(control.by_step) for control in _with_steps(results, category, view, stream)
            },
        )

    @property
    def measure(self) -> str:
        """The metric, at each step by itself."""
        return f"{self.metric} at each step"

    def further_handles(self) -> "Sequence[Artist]":
        """Return the handles of filled and open markers."""
        return significance_handles()

    def draw(self, axes: "Axes") -> None:
        """The site's and the controls' scores."""
        from matplotlib.ticker import MaxNLocator

        line = PARTS[self.part]
        # Rounding makes arms of less than nothing, where groups agree.
        arms = np.array([self.score - self.low, self.high - self.score]).clip(min=0)
        axes.errorbar(self.steps, self.score, yerr=arms, fmt="none", ecolor=line.colour, elinewidth=0.8, alpha=0.7)
        axes.plot(
            self.steps, self.score, color=line.colour, lw=1.3, marker=line.marker, ms=4.5,
            mfc=line.colour if self.signal else "white", label=f"best site, {self.part}",
        )  # fmt: skip
        for (name, scores), dash in zip(self.controls.items(), _CONTROLS, strict=False):
            axes.plot(self.steps, scores, color=dash.colour, ls=dash.dash, lw=1.2, label=f"control {name}")
        axes.axhline(0, color="0.85", lw=0.8, zorder=0)
        axes.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True, min_n_ticks=2))
        beginning = "inferences from the event on" if self.from_event else "inference of the episode"
        axes.set_xlabel(beginning, fontsize=8.5)


def _with_steps(results: ProbeResults, category: str, view: str, stream: str) -> list[ControlScore]:
    """The best control and `step`, each once; none of controls that were stored without scores by step."""
    steps = results.curves[category, view].steps.size
    controls = [
        control for control in results.controls.of_stream(category, view, stream) if len(control.by_step) == steps
    ]
    return [control for number, control in enumerate(controls) if number == 0 or control.name == STEP]


def step_scores(results: ProbeResults, view: str | None = None, category: str | None = None) -> "Figure":
    """Score of a label by step, a panel per stream; arguments and errors as of `StepScoresDisplay`."""
    return in_streams(StepScoresDisplay.from_results, results, view, category, 3.1, 2.6, level=True)


@in_report(16, "labels")
def step_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield the figures that a report of these labels shows: of those with several steps."""
    for view in label_views(source):
        if view.curve.steps.size > 1:
            yield view.figure(
                "steps", "Score by step",
                "The same by inference, at the best site of each part, beside controls. Classes are balanced "
                "among those of the step. A step of one class is easy, so compare with the controls at that step.",
                step_scores,
            )  # fmt: skip
