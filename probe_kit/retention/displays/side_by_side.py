"""Layer curves of several views, models or runs on one scale, and maps in a row."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from textwrap import fill
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.hooks.contract.sites import label_of
from probe_kit.retention.choices import Iterations
from probe_kit.retention.columns.text import title_of
from probe_kit.retention.displays.display import (
    ABOVE_CHANCE,
    Display,
    ProvenanceLine,
    accuracy_axis,
    best_of,
    curve_of,
    in_panels,
    known_view,
    layer_axis,
    scores_of,
    series,
    significance_handles,
)
from probe_kit.retention.displays.iteration_maps import IterationMapDisplay
from probe_kit.retention.displays.layer_curves import StreamCurve, draw_line, select_iterations
from probe_kit.retention.displays.report_figure import (
    DOTS,
    ONLY_FILLED,
    FigureSource,
    ReportFigure,
    in_report,
    in_view,
    view_suffix,
)
from probe_kit.runs.reader import full_name
from probe_kit.statistics.crossfit import CHANCE
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(kw_only=True)
class CurvesDisplay(Display):
    """Held-out accuracy by layer, one line per name, for one category; of each layer the best iteration.

    Along the lower side are layers, or depth as a fraction where curves differ in their number.

    Attributes:
        curves: Curves by name, such as a view or a run.
        looks: Names that are drawn alike in all panels, in order.
        has_bars: Whether layers have their 95 % intervals.
    """

    measure: str = "held-out accuracy (%)"
    curves: Mapping[str, StreamCurve]
    looks: tuple[str, ...]
    has_bars: bool = True
    panel_size: ClassVar = (3.6, 2.3)

    def further_handles(self) -> "Sequence[Artist]":
        """Return the handles of filled and open markers."""
        return significance_handles()

    def draw(self, axes: "Axes") -> None:
        """Draw a line per name, and chance."""
        axes.axhline(100 * CHANCE, color="0.45", lw=1, ls="--", label="chance")
        lengths = {int(curve.layers.max()) for curve in self.curves.values()}
        by_depth = len(lengths) > 1
        # Lines stand apart, so that bars do not hide each other.
        apart = 0.1 / (max(lengths) if by_depth else 1)
        for rank, (name, curve) in enumerate(self.curves.items()):
            line = replace(curve.lines[0], layers=curve.depth) if by_depth else curve.lines[0]
            shift = apart * (rank - (len(self.curves) - 1) / 2)
            draw_line(axes, line, series(self.looks.index(name)), name, shift, bars=self.has_bars)
        accuracy_axis(axes)
        if by_depth:
            axes.set_xlim(-0.04, 1.04)
            axes.set_xlabel("depth", fontsize=8.5)
        else:
            layer_axis(axes, max(lengths) + 1)


def _curves(tables: "Mapping[str, pd.DataFrame]", iterations: Iterations) -> dict[str, StreamCurve]:
    """Return the curve of each table of scores that has rows, of the best iteration."""
    return {
        name: StreamCurve.of_stream(rows, best_of(iterations)) for name, rows in tables.items() if not rows.empty
    }


class RoleCurvesDisplay(CurvesDisplay):
    """Held-out accuracy by layer, one line per view of one stream, for one category.

    Curves are by view, such as `mean:language`; of iterative streams, the best of the iterations at each layer.
    """

    panel_size: ClassVar = (3.1, 2.5)

    @classmethod
    def from_results(
        cls,
        results: ProbeResults,
        category: str,
        stream: str = "backbone",
        views: Sequence[str] | None = None,
        iterations: Iterations = "best",
    ) -> Self:
        """Read stored probes.

        Args:
            results: Probes of one run.
            category: The category that is drawn.
            stream: The stream that is drawn.
            views: Views that are drawn; None for all probed ones of the stream.
            iterations: Iterations that take part.

        Raises:
            UnknownSiteError: For a view that was not probed in the stream.
            UnknownCategoryError: For a category that was not probed.
        """
        candidates = tuple(views or results.settings.views)
        curve_of(results, category, results.settings.views[0])
        curves = _curves({view: scores_of(results, category, view, stream) for view in candidates}, iterations)
        # By default a view that other streams have alone is left out; one that is named is not.
        missing = [view for view in candidates if view not in curves]
        if not curves or (views and missing):
            probed = dict.fromkeys(results.scores.loc[results.scores["stream"] == stream, "view"])
            raise UnknownSiteError(
                f"stream {stream!r} was not probed in {', '.join(missing)}; "
                f"its probed views: {', '.join(probed) or 'none'}"
            )
        certificate = ProvenanceLine.of_results(results, next(iter(curves)))
        title = f"{title_of(category)}: {label_of(stream)}"
        return cls(title=title, curves=curves, looks=tuple(curves), certificates=(certificate,))


def role_curves(
    results: ProbeResults,
    stream: str = "backbone",
    views: Sequence[str] | None = None,
    iterations: Iterations = "best",
) -> "Figure":
    """Return a figure of curves of all probed views of one stream, a panel per category.

    Args:
        results: Probes of one run.
        stream: The stream that is drawn.
        views: Views that are drawn; None for all probed ones of the stream.
        iterations: Iterations that take part.

    Raises:
        UnknownSiteError: For a view that was not probed in the stream.
    """
    categories = results.settings.categories
    return in_panels(
        [RoleCurvesDisplay.from_results(results, name, stream, views, iterations) for name in categories]
    )


@in_report(11)
def role_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield a figure per run and stream that was probed in several views."""
    for drawn in source.runs:
        if drawn.results is None:
            continue
        for stream, rows in drawn.results.scores.groupby("stream", sort=False):
            if rows["view"].nunique() > 1:
                yield ReportFigure(
                    f"{drawn.stem}-roles-{stream}", f"Whose tokens carry the answer: {stream}", "probes",
                    "The same probes on the mean of one kind of token at a time.",
                    drawn.position,
                    partial(role_curves, drawn.results, str(stream), iterations=source.table.iterations),
                    is_detail=True,
                )  # fmt: skip


# -- models by depth -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ModelCurve:
    """Accuracy above chance by layer, and by depth as its fraction; (L,) each, averaged over categories.

    Attributes:
        above_chance: (L,) accuracy minus chance, as a share.
        categories: Number of categories in the mean.
    """

    model: str
    layers: NDArray[np.int64]
    depth: NDArray[np.float64]
    above_chance: NDArray[np.float64]
    categories: int


@dataclass(kw_only=True)
class ModelDepthDisplay(Display):
    """Held-out accuracy above chance against depth, averaged over categories, one line per model.

    At each layer the best of the iterations counts, in each category by itself. Lines have no markers: a mean over
    categories has no p. Layer numbers are those of the deepest model, whose length the others are stretched to.
    """

    stream: str
    models: tuple[ModelCurve, ...]
    panel_size: ClassVar = (4.1, 2.5)
    title_size: ClassVar = 10

    @classmethod
    def from_results(
        cls,
        results: Sequence[ProbeResults],
        stream: str = "backbone",
        view: str | None = None,
        iterations: Iterations = "best",
        names: Sequence[str] | None = None,
    ) -> Self:
        """Read the stored probes of several runs.

        Args:
            results: Probes of a side, one per run.
            stream: The stream that is drawn.
            view: A probed view; None for the first one of each run.
            iterations: Iterations that take part.
            names: Names of the runs, in order; None for their labels when they were probed.

        Raises:
            UnknownSiteError: For a view that was not probed.
            UsageError: If no run has that stream, or for probes of a target that is no side: other metrics have no
                common scale.
        """
        if labels := [probes.settings.target for probes in results if not probes.settings.balanced]:
            raise UsageError(
                f"models are compared by accuracies of a side; some probes are of {labels[0]!r}. Draw their layer "
                "curves"
            )
        called = names or [full_name(probes.label, probes.settings.random_weights) for probes in results]
        every = [(probes, known_view(probes, view), name) for probes, name in zip(results, called, strict=True)]
        with_stream = [entry for entry in every if (entry[0].scores["stream"] == stream).any()]
        if not with_stream:
            raise UsageError(f"none of the {len(results)} runs has probes of stream {stream!r}")
        return cls(
            title=label_of(stream),
            measure="above chance\n(points, mean of categories)",
            stream=stream,
            models=tuple(
                _depth_curve(probes, stream, probed_view, iterations, name)
                for probes, probed_view, name in with_stream
            ),
            certificates=tuple(
                ProvenanceLine.of_results(probes, probed_view) for probes, probed_view, _ in with_stream
            ),
        )

    def draw(self, axes: "Axes") -> None:
        """Draw a line per model over the layers of the deepest, with depth above."""
        axes.axhline(0, color="0.45", lw=1, ls=(0, (1, 1)))
        last = max(int(model.layers.max()) for model in self.models)
        for position, model in enumerate(self.models):
            line = series(position)
            label = f"{model.model}, {model.layers.max() + 1} layers"
            axes.plot(
                last * model.depth, 100 * model.above_chance, color=line.colour, ls=line.dash, lw=1.6, label=label
            )
        axes.set_ylim(*ABOVE_CHANCE)
        layer_axis(axes, last + 1)
        if any(model.layers.max() < last for model in self.models):
            axes.set_xlabel("layer (of the deepest model)", fontsize=8.5)
        _draw_fractions(axes, last)


def model_depths(
    results: Sequence[ProbeResults],
    view: str | None = None,
    iterations: Iterations = "best",
    names: Sequence[str] | None = None,
) -> "Figure":
    """Return a figure of backbones, and of where actions are made, on one scale.

    Args:
        results: Probes of a side, one per run.
        view: A probed view; None for the first one of each run.
        iterations: Iterations that take part.
        names: Names of the runs, in order; None for their labels when they were probed.

    Raises:
        UsageError: If no run has either part.
    """
    parts = {
        (str(part), str(name))
        for probes in results
        for part, name in zip(probes.scores["part"], probes.scores["stream"], strict=True)
    }
    streams = [name for part in ("backbone", "action") for part_of, name in sorted(parts) if part_of == part]
    displays = [ModelDepthDisplay.from_results(results, stream, view, iterations, names) for stream in streams]
    if not displays:
        raise UsageError("no run has probes of a backbone or an action expert")
    return in_panels(displays)


def _draw_fractions(axes: "Axes", last: int) -> None:
    """Draw depth as a fraction along the upper side."""
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


def _depth_curve(results: ProbeResults, stream: str, view: str, iterations: Iterations, name: str) -> ModelCurve:
    curves = []
    for category in results.settings.categories:
        scores = scores_of(results, category, view, stream)
        if not scores.empty:
            scores = select_iterations(scores, iterations)
            curves.append(scores.groupby("layer")["accuracy"].max() - scores["chance"].iloc[0])
    layers = curves[0].index.to_numpy(dtype=np.int64)
    depth = layers / max(1, layers.max())
    return ModelCurve(
        name, layers, depth, np.mean([curve.to_numpy(dtype=float) for curve in curves], axis=0), len(curves)
    )


@in_report(3)
def depth_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield a figure of all probed runs, if there are several."""
    results = [run.results for run in source.runs if run.results is not None]
    if len(results) > 1:
        names = [run.name for run in source.runs if run.results is not None]
        yield ReportFigure(
            "model-depths", "Models by depth", "probes",
            "How far above chance the answer can be read, against depth as a fraction, so that models with "
            "different numbers of layers can be compared.",
            None, partial(model_depths, results, iterations=source.table.iterations, names=names), is_detail=True,
        )  # fmt: skip


# -- runs ----------------------------------------------------------------------------------------------------

PARTS = {"backbone": "backbone", "action": "where the action is made"}
_IN_A_ROW = 4
"""Maps side by side, of 2.7 inches each."""
_TITLE_LETTERS = 36
"""Letters of a line above a map."""


def curves_side_by_side(
    results: Sequence[ProbeResults],
    names: Sequence[str],
    view: str,
    iterations: Iterations = "best",
    categories: Sequence[str] | None = None,
) -> "Figure":
    """Return a figure of layer curves of several runs: a panel per category and part of the model, a line per run.

    Of iterative streams the best of the iterations at each layer counts. Lines have no intervals: the table shows
    whether two runs differ. Along the lower side layers, or depth as a fraction where runs differ in their number.

    Args:
        results: Probes of a side, one per run.
        names: Names of the runs, in order.
        view: A view that some of them were probed in.
        iterations: Iterations that take part.
        categories: The categories that are drawn; None for all.

    Raises:
        UsageError: If no run was probed in the view.
    """
    probed = {name: probes for name, probes in zip(names, results, strict=True) if view in probes.settings.views}
    lines = tuple(ProvenanceLine.of_results(probes, view) for probes in probed.values())
    displays = []
    for category in categories or _categories(probed.values()):
        for part, where in PARTS.items():
            tables = {name: _part_scores(probes, category, view, part) for name, probes in probed.items()}
            if curves := _curves(tables, iterations):
                title, looks = f"{title_of(category)}: {where}", tuple(names)
                displays.append(
                    CurvesDisplay(title=title, curves=curves, looks=looks, certificates=lines, has_bars=False)
                )
    if not displays:
        raise UsageError(f"no run has probes of a backbone or where the action is made in view {view!r}")
    return in_panels(displays, columns=2)


def _categories(results: Iterable[ProbeResults]) -> list[str]:
    return list(dict.fromkeys(name for probes in results for name in probes.settings.categories))


def _part_scores(results: ProbeResults, category: str, view: str, part: str) -> "pd.DataFrame":
    """Return the scores of the first stream of a part of the model; none if none was probed."""
    scores = scores_of(results, category, view)
    scores = scores[scores["part"] == part]
    return scores[scores["stream"].eq(scores["stream"].iloc[0])] if len(scores) else scores


def maps_side_by_side(results: Sequence[ProbeResults], names: Sequence[str], view: str) -> "Figure":
    """Return layer × iteration maps of where the action is made: a row per category, a column per run, one scale.

    Args:
        results: Probes of a side, one per run.
        names: Names of the runs, in order.
        view: A view that at least two of them were probed in.

    Raises:
        UsageError: If fewer than two runs have iterations in that view.
    """
    with_maps = [(name, probes) for name, probes in zip(names, results, strict=True) if has_maps(probes, view)]
    if len(with_maps) < 2:
        raise UsageError(f"fewer than two runs have iterations in view {view!r}; `iteration_maps` draws one")
    across = min(_IN_A_ROW, len(with_maps))
    maps: list[Display | None] = []
    for category in _categories(probes for _, probes in with_maps):
        maps += [
            replace(
                IterationMapDisplay.from_results(probes, category, view),
                title=fill(f"{title_of(category)}: {name}", _TITLE_LETTERS),
            )
            if category in probes.settings.categories
            else None
            for name, probes in with_maps
        ]
        maps += [None] * (-len(with_maps) % across)
    return in_panels(maps, columns=across)


def has_maps(results: ProbeResults, view: str) -> bool:
    """Whether the action of a run is made in iterations that were probed in that view."""
    scores = results.scores
    return bool(((scores["view"] == view) & (scores["part"] == "action") & scores["iteration"].notna()).any())


@in_report(5)
def side_by_side_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield curves and maps of the runs that were probed in a view, if there are several."""
    probed = [(run.results, run.name) for run in source.runs if run.results is not None]
    views = list(dict.fromkeys(view for results, _ in probed for view in results.settings.views))
    for view in views:
        named_results = [(results, name) for results, name in probed if view in results.settings.views]
        if len(named_results) < 2:
            continue
        of_view, called = [results for results, _ in named_results], [name for _, name in named_results]
        yield ReportFigure(
            f"curves-side-by-side{view_suffix(view, views)}", in_view("Layer curves side by side", view, views),
            "probes",
            "How often a linear probe names the side of the correct picture, layer by layer, a line per run "
            f"on one scale; of several iterations the best of every layer. {ONLY_FILLED}. "
            "The table says whether two runs differ.",
            None, partial(curves_side_by_side, of_view, called, view, source.table.iterations),
            is_detail=view != views[0],
        )  # fmt: skip
        if sum(has_maps(results, view) for results in of_view) > 1:
            yield ReportFigure(
                f"maps-side-by-side{view_suffix(view, views)}",
                in_view("Layer × iteration side by side", view, views), "probes",
                "Where and when the answer can be read while the action is made, a column per run. Colours "
                f"run from chance to 100 % in every map. {DOTS}.",
                None, partial(maps_side_by_side, of_view, called, view), is_detail=True,
            )  # fmt: skip
