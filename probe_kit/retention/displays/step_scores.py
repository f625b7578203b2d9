"""Score of a label at every step of the window, with those of its controls."""

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
from probe_kit.retention.displays.base.selection import best_row, probed_curve, scores_of
from probe_kit.retention.displays.base.style import GREEN, PARTS, Line, significance_handles
from probe_kit.retention.rows.probe_parts import STEP
from probe_kit.train.crossval.task_scores import METRICS, score_interval
from probe_kit.train.results.control_scores import ControlScore
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CONTROLS = (Line("black", "", ":"), Line(GREEN, "", (0, (5, 1))))  # type: ignore[arg-type]  # as `SERIES`


@dataclass
class StepScoresDisplay(Panelled):
    """The metric at each step, of the best site of a stream; arrays (W,).

    R² is that of the label's spread over all steps. Balanced accuracy is that of the classes at the
    step. steps: inferences, or places behind the event where windows begin. low, high: 95 % interval over groups.
    controls: by name, the metric of the best control and of `step`. site: of the largest score above its
    own chance. signal: whether the site exceeds chance, family-wise, and every control that was run.
    """

    target: str
    metric: str
    view: str
    stream: str
    part: str
    site: str
    signal: bool
    steps: NDArray[np.int64]
    from_event: bool
    score: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    controls: dict[str, NDArray[np.float64]]
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
            score_interval(
                balanced[at_step],
                curve.labels[at_step],
                curve.groups[at_step],
                settings.task,
                curve.deviations[at_step],
            )
            for at_step in (curve.places == step for step in curve.steps)
        ]
        return cls(
            target=settings.target,
            metric=METRICS[settings.task],
            view=view,
            stream=stream,
            part=curve.parts[row],
            site=str(curve.sites[row]),
            signal=bool(table.loc[str(curve.sites[row]), "signal"]),
            steps=curve.steps,
            from_event=curve.aligned is not None,
            score=curve.by_step(scores),
            low=np.array([low for low, _ in limits]),
            high=np.array([high for _, high in limits]),
            controls={
                control.name: np.array(control.by_step) for control in _with_steps(results, category, view, stream)
            },
            certificate=ProvenanceLine.of_label(results, category, view),
        )

    @property
    def title(self) -> str:
        """The site."""
        return self.site

    @property
    def measure(self) -> str:
        """The metric, at each step by itself."""
        return f"{self.metric} at each step"

    def further_handles(self) -> "list[Artist]":
        """Return the handles of filled and open markers."""
        return list(significance_handles())

    def draw(self, axes: "Axes") -> None:
        """The site's and the controls' scores."""
        line = PARTS[self.part]
        arms = np.array([self.score - self.low, self.high - self.score]).clip(
            min=0
        )  # rounding, where groups agree
        axes.errorbar(self.steps, self.score, yerr=arms, fmt="none", ecolor=line.colour, elinewidth=0.8, alpha=0.7)
        axes.plot(
            self.steps,
            self.score,
            color=line.colour,
            lw=1.3,
            marker=line.marker,
            ms=4.5,
            mfc=line.colour if self.signal else "white",
            label=f"best site, {self.part}",
        )
        for (name, scores), dash in zip(self.controls.items(), _CONTROLS, strict=False):
            axes.plot(self.steps, scores, color=dash.colour, ls=dash.dash, lw=1.2, label=f"control {name}")
        axes.axhline(0, color="0.85", lw=0.8, zorder=0)
        _whole_numbers(axes, "inferences from the event on" if self.from_event else "inference of the episode")


def _with_steps(results: ProbeResults, category: str, view: str, stream: str) -> list[ControlScore]:
    """The best control and `step`, each once; none of controls that were stored without scores by step."""
    steps = results.curves[category, view].steps.size
    controls = [
        control for control in results.controls.of_stream(category, view, stream) if len(control.by_step) == steps
    ]
    return [control for number, control in enumerate(controls) if number == 0 or control.name == STEP]


def _whole_numbers(axes: "Axes", label: str) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True, min_n_ticks=2))
    axes.set_xlabel(label, fontsize=8.5)


def step_scores(results: ProbeResults, view: str | None = None, category: str | None = None) -> "Figure":
    """Score of a label by step, a panel per stream; arguments and errors as of `StepScoresDisplay`."""
    return in_streams(StepScoresDisplay.from_results, results, view, category, 3.1, 2.6, level=True)


PLACE = 16
"""Of its figures in the report."""


def label_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield the figures that a report of these labels shows: of those with several steps."""
    for view in label_views(source):
        if view.curve.steps.size > 1:
            yield view.figure(
                "steps", "Score by step",
                "The same by inference, at the best site of each part, beside controls. Classes are balanced "
                "among those of the step. A step of one class is easy, so compare with the controls at that step.",
                partial(step_scores, view.results, view.name, view.category),
            )  # fmt: skip
