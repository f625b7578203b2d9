"""The knowledge–action gap: what a probe reads inside the model against what the model does."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Self

from probe_kit.errors import UsageError
from probe_kit.retention.columns.text import RATE, Modes, model_name, modes_of, title_of
from probe_kit.retention.displays.base.display import Display
from probe_kit.retention.displays.base.label_placement import place_labels
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import FigureSource, ReportFigure, figure_of
from probe_kit.retention.displays.base.style import (
    axes_for,
    caption,
    darker,
    legend_above,
    plain,
    series,
    significance_handles,
)
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.retention.table import RetentionTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Limits = tuple[float | None, float | None] | None


@dataclass(frozen=True)
class GapPoint:
    """One category of one run: probe accuracy and success rate, as shares, with 95 % intervals if known."""

    model: str
    category: str
    accuracy: float
    accuracy_ci: Limits
    sr: float
    sr_ci: Limits
    significant: bool


@dataclass
class KnowledgeActionDisplay(Display):
    """Success rate against the best probe of a stream, a point per category and model.

    On the diagonal success equals what can be read; below it, more is decodable. Both axes run from 0 to
    100 %, whatever is shown. modes: whether the shares are of policies, of answers or of both.
    """

    stream: str
    points: tuple[GapPoint, ...]
    certificates: tuple[ProvenanceLine, ...]
    modes: Modes = "acts"
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def from_table(
        cls, table: RetentionTable, stream: Literal["backbone", "expert"] = "backbone", view: str | None = None
    ) -> Self:
        """Read a retention table; view: the first one of each run by default.

        Raises UsageError if no run was probed in that stream and view.
        """
        view_of: dict[tuple[str | None, str], str | None] = {}
        points, drawn = [], []
        for row in table.rows:
            if row.view is None or view_of.setdefault((row.group, row.run.location), view or row.view) != row.view:
                continue
            if (point := _point(row, stream)) is not None:
                points.append(point)
                drawn.append(row)
        if not points:
            raise UsageError(
                f"no run that acted has probes of stream {stream!r}" + (f" in view {view!r}" if view else "")
            )
        means = (
            mean for mean in table.means if view_of.get((mean.group, mean.run.location)) == mean.view is not None
        )
        certificates = tuple(ProvenanceLine.of_row(mean) for mean in means)
        return cls(stream, tuple(points), certificates, modes_of(drawn))

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with legend and captions."""
        models = list(dict.fromkeys(point.model for point in self.points))
        axes, figure = axes_for(ax, 6.2, 6.7 + 0.17 * len(models))
        _draw_ground(axes)
        for position, model in enumerate(models):
            _draw_model(axes, [point for point in self.points if point.model == model], position, model)
        plain(axes)
        output = "answer" if self.modes == "answers" else "action"
        where = "in the backbone" if self.stream == "backbone" else f"where the {output} is made"
        axes.set_xlabel(f"best held-out probe {where} (%)", fontsize=9)
        axes.set_ylabel(f"{RATE[self.modes].lower()} (%)", fontsize=9)
        if figure is not None:
            legend_above(figure, [*axes.get_legend_handles_labels()[0], *significance_handles()])
        caption(figure, *self.certificates)
        if figure is not None:
            figure.draw_without_rendering()  # labels need the final places of points
        words = [title_of(point.category) for point in self.points]
        inks = [darker(series(models.index(point.model)).colour) for point in self.points]
        points = [(100 * point.accuracy, 100 * point.sr) for point in self.points]
        bars = [ends for point in self.points for ends in _bars(point)]
        # `place_labels` knows level and upright lines: the diagonal is a stair of short ones.
        diagonal = [((step, step), (step + 1, step + 1)) for step in range(100)]
        guessing = [((0, 50), (100, 50)), ((50, 0), (50, 100))]
        place_labels(axes, points, words, inks, [*bars, *diagonal, *guessing])
        self.ax_ = axes
        return self


def _point(row: RetentionRow, stream: str) -> GapPoint | None:
    in_backbone = stream == "backbone"
    accuracy = row.backbone.score if in_backbone else row.action.score
    if accuracy is None or row.success.sr is None or row.success.ci is None:
        return None
    return GapPoint(
        model=model_name(row),
        category=row.category,
        accuracy=accuracy,
        accuracy_ci=row.backbone.ci if in_backbone else row.action.ci,
        sr=row.success.sr,
        sr_ci=row.success.ci,
        significant=row.backbone.has_signal if in_backbone else row.action.has_signal,
    )


def _draw_ground(axes: "Axes") -> None:
    axes.fill_between([0, 100], [0, 100], [0, 0], color="0.955", lw=0, zorder=0)
    axes.plot([0, 100], [0, 100], color="0.45", lw=1, zorder=1)
    for draw in (axes.axvline, axes.axhline):
        draw(50, color="0.45", lw=0.8, ls="--", zorder=1)
    # Below the diagonal where accuracies are far below chance: points are rare there.
    axes.text(
        6,
        4,
        "more decodable than success shows",
        va="top",
        rotation=45,
        rotation_mode="anchor",
        transform_rotates_text=True,
        fontsize=8,
        style="italic",
        color="0.35",
    )
    axes.text(0.5, 50.5, "guessing", fontsize=7, color="0.35")
    axes.text(50.5, 100, "chance", fontsize=7, color="0.35", rotation=90, va="top")
    axes.set_xlim(-2, 102)
    axes.set_ylim(-2, 102)
    axes.set_aspect("equal")


def _draw_model(axes: "Axes", points: Sequence[GapPoint], position: int, model: str) -> None:
    line = series(position)
    for point in points:
        across, up = _arms(point.accuracy, point.accuracy_ci), _arms(point.sr, point.sr_ci)
        axes.errorbar(
            100 * point.accuracy, 100 * point.sr, xerr=across, yerr=up, fmt="none", ecolor=line.colour,
            elinewidth=0.7, alpha=0.28, zorder=2,
        )  # fmt: skip
    for filled in (True, False):
        of_marker = [point for point in points if point.significant == filled]
        axes.plot(
            [100 * point.accuracy for point in of_marker], [100 * point.sr for point in of_marker], ls="none",
            marker=line.marker, ms=6, color=line.colour, mfc=line.colour if filled else "white",
            label=model if filled else None, zorder=3,
        )  # fmt: skip


def _bars(point: GapPoint) -> "list[tuple[tuple[float, float], tuple[float, float]]]":
    """The ends of a point's error bars, in percent."""
    x, y = 100 * point.accuracy, 100 * point.sr
    across, up = _arms(point.accuracy, point.accuracy_ci), _arms(point.sr, point.sr_ci)
    level = [] if across is None else [((x - across[0][0], y), (x + across[1][0], y))]
    upright = [] if up is None else [((x, y - up[0][0]), (x, y + up[1][0]))]
    return level + upright


def _arms(value: float, limits: Limits) -> list[list[float]] | None:
    if limits is None or limits[0] is None or limits[1] is None:
        return None
    return [[max(0.0, 100 * (value - limits[0]))], [max(0.0, 100 * (limits[1] - value))]]


_DOES: dict[Modes, str] = {"acts": "succeeds", "answers": "says it", "both": "succeeds or says it"}
PLACE = 2
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    acted = [row for row in source.table.rows if row.success.sr is not None]
    modes = modes_of(acted)
    if any(row.backbone.score is not None for row in acted):
        answers = modes == "answers"
        yield ReportFigure(
            "knowledge-action", f"Knowledge and {'answers' if answers else 'action'}", "retention",
            "Each point is one category: how well the answer can be read inside the model (across) and how often "
            f"the model {_DOES[modes]} (up). Far below the line, more can be read than "
            f"{'the answers show' if answers else 'success shows'}.",
            None, lambda: figure_of(KnowledgeActionDisplay.from_table(source.table)),
        )  # fmt: skip
