"""Figures of labels: classes that are confused, predicted against true values, and scores by step."""

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.retention.displays.display import (
    BLUE,
    GREEN,
    PARTS,
    Display,
    LineLook,
    ProvenanceLine,
    best_row,
    draw_intervals,
    in_panels,
    probed_curve,
    scores_of,
    significance_handles,
)
from probe_kit.retention.displays.report_figure import FigureSource, ReportFigure, in_report, probed_views
from probe_kit.retention.estimators import STEP
from probe_kit.train.crossval.task_scores import METRICS, score_interval
from probe_kit.train.results.control_scores import ControlScore
from probe_kit.train.results.probe_curve import ProbeCurve
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(kw_only=True)
class BestSiteDisplay(Display):
    """A panel of a label's probes at the best site of a stream: that of the largest score above its own chance.

    Attributes:
        curve: The probes of this site alone.
        signal: Whether it exceeds chance, family-wise, and every control that was run.
        scores_of_controls: The controls that it is compared with, the best first.
    """

    target: str
    view: str
    stream: str
    curve: ProbeCurve
    signal: bool
    scores_of_controls: tuple[ControlScore, ...]

    @classmethod
    def from_results(
        cls,
        results: ProbeResults,
        stream: str = "backbone",
        view: str | None = None,
        category: str | None = None,
    ) -> Self:
        """Read stored probes of a label.

        Args:
            results: Probes of one run.
            stream: The stream whose best site is drawn.
            view: A probed view; None for the first.
            category: A probed category; None for the first.

        Raises:
            UnknownSiteError: For a view or stream that was not probed.
            UsageError: For labels of another kind.
        """
        category, view, curve = probed_curve(results, view, category)
        if why_not := cls.why_not(curve):
            raise UsageError(f"the label {results.settings.target!r} {why_not}")
        row = best_row(curve, stream)
        return cls(
            target=results.settings.target,
            view=view,
            stream=stream,
            curve=curve.only(row),
            title=str(curve.sites[row]),
            signal=bool(scores_of(results, category, view)["signal"].iloc[row]),
            scores_of_controls=results.controls.of_stream(category, view, stream),
            certificates=(ProvenanceLine.of_results(results, view, category),),
        )

    @staticmethod
    @abstractmethod
    def why_not(curve: ProbeCurve) -> str:
        """Return the reason why labels have no such figure, and the expected kind; empty where they have."""

    @property
    def site(self) -> str:
        """The name of the site."""
        return str(self.curve.sites[0])


def _in_streams(
    display: type[BestSiteDisplay], results: ProbeResults, view: str | None, category: str | None
) -> "Figure":
    """Return a panel per stream that was probed in a view and category, by default the first ones."""
    category, view, curve = probed_curve(results, view, category)
    return in_panels([display.from_results(results, stream, view, category) for stream in curve.streams])


# -- confusion of classes ------------------------------------------------------------------------------------

_WITH_NUMBERS = 12
"""Largest number of classes that leaves room for numbers in the cells."""
_LONGEST = 14
"""Letters of a class's name that are shown."""


@dataclass(kw_only=True)
class ClassConfusionDisplay(BestSiteDisplay):
    """Held-out predictions of classes, by true class."""

    measure: str = "true class (samples)"
    panel_size: ClassVar = (3.3, 3.1)

    @staticmethod
    def why_not(curve: ProbeCurve) -> str:
        """Return a reason for quantities, which are not confused."""
        return "" if curve.classes else "is continuous; expected classes to confuse"

    @property
    def counts(self) -> NDArray[np.int64]:
        """The number of samples (K, K) by true class, down, and predicted class, across."""
        from sklearn.metrics import confusion_matrix

        classes = np.arange(len(self.curve.classes))
        counts: NDArray[np.int64] = confusion_matrix(self.curve.labels, self.curve.decisions[0], labels=classes)
        return counts

    @property
    def shares(self) -> NDArray[np.float64]:
        """The shares (K, K) of each true class; the mean of the diagonal is the balanced accuracy."""
        shares: NDArray[np.float64] = self.counts / self.counts.sum(axis=1, keepdims=True).clip(1)
        return shares

    def draw(self, axes: "Axes") -> None:
        """Draw shares of the true class as colours, and in percent."""
        from matplotlib.colors import LinearSegmentedColormap

        shares, places = self.shares, range(len(self.curve.classes))
        colours = LinearSegmentedColormap.from_list("shares", ["white", BLUE])
        axes.imshow(shares, vmin=0, vmax=1, cmap=colours, aspect="auto")
        names = [name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}…" for name in self.curve.classes]
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
    """Return a figure of confusion matrices, a panel per stream.

    Arguments and errors are those of `ClassConfusionDisplay.from_results`.
    """
    return _in_streams(ClassConfusionDisplay, results, view, category)


@in_report(17, "labels")
def confusion_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield the confusion matrices of the probed views of labels with classes."""
    for view in probed_views(source):
        if view.curve.classes:
            yield view.figure(
                "confusion", "Confusion matrix",
                "Which class the best site of each part predicts for which, in groups it has not seen. Each row "
                "sums to 100 %; the mean of the diagonal is the balanced accuracy.",
                class_confusions, view.category,
            )  # fmt: skip


# -- predicted against true values ---------------------------------------------------------------------------

_PIXELS_FROM = 2000
"""Number of points from which on a figure holds them as pixels."""


@dataclass(kw_only=True)
class PredictedValuesDisplay(BestSiteDisplay):
    """Held-out predictions of a quantity against its true values."""

    measure: str = "predicted value"
    is_level: bool = True
    panel_size: ClassVar = (3.3, 3.0)

    def __post_init__(self) -> None:
        self.title += f", {METRICS['continuous']} {self.curve.metric[0]:.2f}"

    @staticmethod
    def why_not(curve: ProbeCurve) -> str:
        """Return a reason for classes, which have no values."""
        return "" if curve.task == "continuous" else "is of classes; expected a continuous one"

    @property
    def true(self) -> NDArray[np.float64]:
        """The labels (n,) in their own unit."""
        labels: NDArray[np.float64] = self.curve.labels
        return labels

    @property
    def predicted(self) -> NDArray[np.float64]:
        """The held-out predictions (n,) in the unit of the label."""
        predicted: NDArray[np.float64] = self.curve.decisions[0]
        return predicted

    @property
    def groups(self) -> NDArray[np.int64]:
        """The number (n,) of each sample's group, which is its colour."""
        return np.asarray(np.unique(self.curve.groups, return_inverse=True)[1], np.int64)

    def draw(self, axes: "Axes") -> None:
        """Draw a point per sample, and the line on which prediction and label are equal."""
        low = float(min(self.true.min(), self.predicted.min()))
        high = float(max(self.true.max(), self.predicted.max()))
        axes.plot([low, high], [low, high], color="0.6", lw=0.9, ls="--", label="predicted = true")
        axes.scatter(
            self.true, self.predicted, c=self.groups, cmap="turbo", s=9, alpha=0.6, lw=0,
            rasterized=self.true.size > _PIXELS_FROM, label="a sample; its colour is its group",
        )  # fmt: skip
        axes.set_xlabel("true value", fontsize=8.5)


def predicted_values(results: ProbeResults, view: str | None = None, category: str | None = None) -> "Figure":
    """Return a figure of predicted against true values, a panel per stream.

    Arguments and errors are those of `PredictedValuesDisplay.from_results`.
    """
    return _in_streams(PredictedValuesDisplay, results, view, category)


@in_report(18, "labels")
def predicted_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield predicted against true values of the probed views of continuous labels."""
    for view in probed_views(source):
        if not view.curve.classes:
            yield view.figure(
                "predicted", "Predicted against true",
                "A point per sample, predicted by the best site of each part in groups it has not seen. Colours "
                "are groups. Predictions are clipped to the range of the training labels.",
                predicted_values, view.category,
            )  # fmt: skip


# -- scores by step ------------------------------------------------------------------------------------------

_CONTROLS = (LineLook("black", "", ":"), LineLook(GREEN, "", (0, (5, 1))))  # type: ignore[arg-type]  # as `SERIES`


@dataclass(kw_only=True)
class StepScoresDisplay(BestSiteDisplay):
    """The metric at each step; arrays (W,).

    R² is that of the label's spread over all steps. Balanced accuracy is that of the classes at the step.
    """

    is_level: bool = True
    panel_size: ClassVar = (3.1, 2.6)

    def __post_init__(self) -> None:
        self.measure = f"{METRICS[self.curve.task]} at each step"

    @staticmethod
    def why_not(curve: ProbeCurve) -> str:
        """Return a reason for a single step, which is no curve."""
        return "has one step; expected several to show" if curve.steps.size < 2 else ""

    @property
    def steps(self) -> NDArray[np.int64]:
        """The inferences, or places after the event where windows begin."""
        return self.curve.steps

    @property
    def from_event(self) -> bool:
        """Whether windows begin at an event."""
        return self.curve.aligned is not None

    @property
    def score(self) -> NDArray[np.float64]:
        """The metric at each step."""
        return self.curve.by_step(self.curve.scores[0])

    @cached_property
    def limits(self) -> NDArray[np.float64]:
        """The ends (2, W) of the 95 % intervals over groups."""
        curve, balanced = self.curve, self.curve.step_scores(self.curve.scores[0])
        at_steps = [curve.places == step for step in curve.steps]
        intervals = [
            score_interval(balanced[at], curve.labels[at], curve.groups[at], curve.task, curve.deviations[at])
            for at in at_steps
        ]
        return np.array(intervals).T

    @property
    def controls(self) -> dict[str, NDArray[np.float64]]:
        """The metric of the best control and of `step`, by name; only of controls that have it at each step."""
        scores = [score for score in self.scores_of_controls if len(score.by_step) == self.steps.size]
        return {
            score.name: np.array(score.by_step) for at, score in enumerate(scores) if at == 0 or score.name == STEP
        }

    def further_handles(self) -> "Sequence[Artist]":
        """Return the handles of filled and open markers."""
        return significance_handles()

    def draw(self, axes: "Axes") -> None:
        """Draw the scores of the site and of the controls."""
        from matplotlib.ticker import MaxNLocator

        (part,), score = self.curve.parts, self.score
        line = PARTS[part]
        draw_intervals(axes, self.steps, score, line.colour, self.limits)
        axes.plot(
            self.steps, score, color=line.colour, lw=1.3, marker=line.marker, ms=4.5,
            mfc=line.colour if self.signal else "white", label=f"best site, {part}",
        )  # fmt: skip
        for (name, scores), dash in zip(self.controls.items(), _CONTROLS, strict=False):
            axes.plot(self.steps, scores, color=dash.colour, ls=dash.dash, lw=1.2, label=f"control {name}")
        axes.axhline(0, color="0.85", lw=0.8, zorder=0)
        axes.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True, min_n_ticks=2))
        beginning = "inferences from the event on" if self.from_event else "inference of the episode"
        axes.set_xlabel(beginning, fontsize=8.5)


def step_scores(results: ProbeResults, view: str | None = None, category: str | None = None) -> "Figure":
    """Return a figure of a label's score by step, a panel per stream.

    Arguments and errors are those of `StepScoresDisplay.from_results`.
    """
    return _in_streams(StepScoresDisplay, results, view, category)


@in_report(16, "labels")
def step_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield scores by step of the probed views of labels with several steps."""
    for view in probed_views(source):
        if view.curve.steps.size > 1:
            yield view.figure(
                "steps", "Score by step",
                "The same by inference, at the best site of each part, beside controls. Classes are balanced "
                "among those of the step. A step of one class is easy, so compare with the controls at that step.",
                step_scores, view.category,
            )  # fmt: skip
