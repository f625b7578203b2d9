"""Several models on one axis: depth as a fraction makes 18 and 32 layers comparable."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.choices import Iterations
from probe_kit.retention.displays.base.display import Display
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import FigureSource, ReportFigure
from probe_kit.retention.displays.base.selection import known_view, of_iterations, scores_of
from probe_kit.retention.displays.base.style import (
    ABOVE_CHANCE,
    axes_for,
    caption,
    layer_axis,
    legend_above,
    legend_handles,
    plain,
    series,
)
from probe_kit.runs.reader import full_name
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class ModelCurve:
    """Accuracy above chance by layer, and by depth as its fraction; (L,) each, averaged over categories."""

    model: str
    layers: NDArray[np.int64]
    depth: NDArray[np.float64]
    above_chance: NDArray[np.float64]
    categories: int


@dataclass
class ModelDepthDisplay(Display):
    """Held-out accuracy above chance against depth, averaged over categories, one line per model.

    At each layer the best of the iterations counts, in each category by itself. Lines have no markers: a mean over
    categories has no p. Layer numbers are those of the deepest model, whose length the others are stretched to.
    """

    stream: str
    models: tuple[ModelCurve, ...]
    certificates: tuple[ProvenanceLine, ...]
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_results(
        cls,
        results: Sequence[ProbeResults],
        stream: str = "backbone",
        view: str | None = None,
        iterations: Iterations = "best",
        names: Sequence[str] | None = None,
    ) -> Self:
        """Read the stored probes of several runs; view: the first probed one of each by default.

        names: what runs are called, in order; by default as when they were probed.

        Raises UnknownSiteError for a view that was not probed, UsageError if no run has that stream, or for probes
        of a target that is no side: other metrics have no common scale.
        """
        if labels := [probes.settings.target for probes in results if not probes.settings.is_side]:
            raise UsageError(
                f"models are compared by accuracies of a side; some probes are of {labels[0]!r}. Draw their layer "
                "curves"
            )
        called = [_name(probes) for probes in results] if names is None else names
        every = [(probes, known_view(probes, view), name) for probes, name in zip(results, called, strict=True)]
        with_stream = [entry for entry in every if (entry[0].scores["stream"] == stream).any()]
        if not with_stream:
            raise UsageError(f"none of the {len(results)} runs has probes of stream {stream!r}")
        return cls(
            stream=stream,
            models=tuple(
                _curve(probes, stream, probed_view, iterations, name) for probes, probed_view, name in with_stream
            ),
            certificates=tuple(
                ProvenanceLine.of_results(probes, probed_view) for probes, probed_view, _ in with_stream
            ),
        )

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and captions."""
        axes, figure = axes_for(ax, 6.2, 3.9)
        axes.axhline(0, color="0.45", lw=1, ls=(0, (1, 1)))
        last = max(int(model.layers.max()) for model in self.models)
        for position, model in enumerate(self.models):
            line = series(position)
            label = f"{model.model}, {model.layers.max() + 1} layers"
            axes.plot(
                last * model.depth, 100 * model.above_chance, color=line.colour, ls=line.dash, lw=1.6, label=label
            )
        plain(axes)
        axes.set_ylim(*ABOVE_CHANCE)
        layer_axis(axes, last + 1)
        if any(model.layers.max() < last for model in self.models):
            axes.set_xlabel("layer (of the deepest model)", fontsize=8.5)
        _draw_fractions(axes, last)
        axes.set_title(label_of(self.stream), fontsize=10, loc="left")
        if figure is not None:
            axes.set_ylabel("accuracy above chance\n(points, mean of categories)", fontsize=9)
            legend_above(figure, axes.get_legend_handles_labels()[0])
        caption(figure, *self.certificates)
        self.ax_ = axes
        return self


def model_depths(
    results: Sequence[ProbeResults],
    view: str | None = None,
    iterations: Iterations = "best",
    names: Sequence[str] | None = None,
) -> "Figure":
    """Backbones, and where actions are made, on one scale. Raises UsageError if no run has either."""
    from probe_kit.retention.displays.base.shown_figure import ShownFigure

    parts = {
        (str(part), str(name))
        for probes in results
        for part, name in zip(probes.scores["part"], probes.scores["stream"], strict=True)
    }
    streams = [name for part in ("backbone", "action") for part_of, name in sorted(parts) if part_of == part]
    displays = [ModelDepthDisplay.from_results(results, stream, view, iterations, names) for stream in streams]
    if not displays:
        raise UsageError("no run has probes of a backbone or an action expert")
    figure = ShownFigure(figsize=(4.1 * max(len(displays), 1.5), 3.6), layout="constrained", dpi=150)
    grid = figure.subplots(1, len(displays), sharey=True, squeeze=False)[0]
    for display, axes in zip(displays, grid, strict=True):
        display.plot(axes)
    legend_above(figure, list(legend_handles(*grid).values()))
    figure.supylabel("above chance\n(points, mean of categories)", fontsize=8)
    caption(figure, *(certificate for display in displays for certificate in display.certificates))
    return figure


def _draw_fractions(axes: "Axes", last: int) -> None:
    """Depth as a fraction along the upper side."""
    above = axes.secondary_xaxis(
        "top",
        functions=(
            lambda layer: np.asarray(layer, float) / max(1, last),
            lambda depth: np.asarray(depth, float) * last,
        ),
    )
    above.set_ticks([0, 0.25, 0.5, 0.75, 1], labels=["0", "¼", "½", "¾", "1"])
    above.set_xlabel("depth", fontsize=7.5, labelpad=5)
    above.tick_params(labelsize=7.5, pad=1)
    above.spines["top"].set_visible(False)


def _name(results: ProbeResults) -> str:
    return full_name(results.label, results.settings.random_weights)


def _curve(results: ProbeResults, stream: str, view: str, iterations: Iterations, name: str) -> ModelCurve:
    curves = []
    for category in results.settings.categories:
        scores = scores_of(results, category, view)
        scores = scores[scores["stream"] == stream]
        if not scores.empty:
            scores = of_iterations(scores, iterations)
            curves.append(scores.groupby("layer")["accuracy"].max() - scores["chance"].iloc[0])
    layers = curves[0].index.to_numpy(dtype=np.int64)
    depth = layers / max(1, layers.max())
    return ModelCurve(
        name, layers, depth, np.mean([curve.to_numpy(dtype=float) for curve in curves], axis=0), len(curves)
    )


PLACE = 3
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    results = [run.results for run in source.runs if run.results is not None]
    if len(results) > 1:
        names = [run.name for run in source.probed]
        yield ReportFigure(
            "model-depths", "Models by depth", "probes",
            "How far above chance the answer can be read, against depth as a fraction, so that models with "
            "different numbers of layers can be compared.",
            None, partial(model_depths, results, iterations=source.table.iterations, names=names), is_detail=True,
        )  # fmt: skip
