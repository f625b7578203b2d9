"""A figure of a whole table: success against probe accuracy."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from math import nan
from typing import TYPE_CHECKING, Literal, Self

import numpy as np

from probe_kit._tables.numbers import Limits
from probe_kit.errors import UsageError
from probe_kit.retention.columns.text import RATE, Modes, model_name, modes_of, title_of
from probe_kit.retention.displays.display import (
    Display,
    ProvenanceLine,
    darker,
    draw_intervals,
    series,
    significance_handles,
)
from probe_kit.retention.displays.report_figure import FigureSource, ReportFigure, figure_of, in_report
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.retention.table import RetentionTable

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


Point = tuple[float, float]
Box = tuple[float, float, float, float]

_SIZE = 7.5
"""Size of letters, in points."""
# Of one line of text, in points. Estimated: measured widths exist only once the figure is drawn.
_HEIGHT, _CHARACTER = 1.15 * _SIZE, 0.56 * _SIZE
_REACHES = (6.0, 13.0, 22.0, 32.0)  # from the point, in points


def place_labels(
    axes: "Axes",
    points: Sequence[Point],
    names: Sequence[str],
    inks: Sequence[str],
    lines: Sequence[tuple[Point, Point]] = (),
) -> None:
    """Write each name near its point (data coordinates) in its ink, with a thin line where it had to move away.

    Args:
        axes: Axes that hold the points.
        points: Points in data coordinates.
        names: The name of each point.
        inks: The colour of each name.
        lines: Level or upright lines by their ends, such as error bars, which names avoid where they can.
    """
    unit = axes.figure.dpi / 72  # pixels per point of type
    anchors = [axes.transData.transform(point) / unit for point in points]
    corners = axes.get_window_extent()
    frame = (corners.x0 / unit, corners.y0 / unit, corners.x1 / unit, corners.y1 / unit)
    occupied: list[Box] = [(x - 3, y - 3, x + 3, y + 3) for x, y in anchors]
    for ends in lines:
        (x0, y0), (x1, y1) = (axes.transData.transform(end) / unit for end in ends)
        occupied.append((min(x0, x1) - 1, min(y0, y1) - 1, max(x0, x1) + 1, max(y0, y1) + 1))

    def in_data(x: float, y: float) -> Point:
        across, up = axes.transData.inverted().transform((x * unit, y * unit))
        return float(across), float(up)

    for name, ink, point, (x, y) in zip(names, inks, points, anchors, strict=True):
        width = _CHARACTER * len(name)
        boxes = [(reach, _box(x, y, width, reach, side)) for reach, side in product(_REACHES, _SIDES)]
        # The least covered area; of equal ones the nearest. Names that were placed before stay where they are.
        reach, box = min(boxes, key=lambda of: (_covered_area(of[1], occupied) + _outside(of[1], frame), of[0]))
        occupied.append(box)
        start, bottom = in_data(box[0], box[1] + 0.22 * _HEIGHT)
        axes.text(start, bottom, name, fontsize=_SIZE, color=ink, zorder=4)
        if reach > _REACHES[0]:
            across, up = in_data(min(max(x, box[0]), box[2]), min(max(y, box[1]), box[3]))
            axes.plot([point[0], across], [point[1], up], color="0.6", lw=0.5, zorder=1.5)


_SIDES = ((1, 0), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1), (0, 1), (0, -1))
"""Directions across and up from a point, the preferred ones first: text on the right reads best."""


def _box(x: float, y: float, width: float, reach: float, side: tuple[int, int]) -> Box:
    start = x + reach if side[0] > 0 else x - reach - width if side[0] < 0 else x - width / 2
    middle = y + side[1] * (reach if side[0] == 0 else 0.8 * reach)
    bottom = middle - _HEIGHT / 2
    return start, bottom, start + width, bottom + _HEIGHT


def _outside(box: Box, frame: Box) -> float:
    """Return the area of `box` that is not in `frame`, in square points."""
    return (box[2] - box[0]) * (box[3] - box[1]) - _covered_area(box, [frame])


def _covered_area(box: Box, boxes: Sequence[Box]) -> float:
    """Return the area that `box` shares with others, in square points."""
    return sum(
        max(0.0, min(box[2], other[2]) - max(box[0], other[0]))
        * max(0.0, min(box[3], other[3]) - max(box[1], other[1]))
        for other in boxes
    )


@dataclass(frozen=True)
class GapPoint:
    """One category of one run: probe accuracy and success rate, as shares, with 95 % intervals if known."""

    model: str
    category: str
    accuracy: float
    accuracy_ci: Limits | None
    sr: float
    sr_ci: Limits | None
    significant: bool


@dataclass(kw_only=True)
class KnowledgeActionDisplay(Display):
    """Success rate against the best probe of a stream, a point per category and model.

    On the diagonal success equals what can be read; below it, more is decodable. Both axes run from 0 to 100 %,
    whatever is shown.

    Attributes:
        modes: Whether the shares are of policies, of answers or of both.
    """

    stream: str
    points: tuple[GapPoint, ...]
    modes: Modes = "acts"

    @classmethod
    def from_table(
        cls, table: RetentionTable, stream: Literal["backbone", "expert"] = "backbone", view: str | None = None
    ) -> Self:
        """Read a retention table.

        Args:
            table: The table of runs with probes.
            stream: The stream whose probes are drawn.
            view: A probed view; None for the first one of each run.

        Raises:
            UsageError: If no run was probed in that stream and view.
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
        modes, models = modes_of(drawn), {point.model for point in points}
        return cls(
            measure=f"{RATE[modes].lower()} (%)",
            figure_size=(6.2, 5.6 + 0.17 * len(models)),  # the axes are square
            stream=stream,
            points=tuple(points),
            certificates=certificates,
            modes=modes,
        )

    @property
    def _models(self) -> list[str]:
        return list(dict.fromkeys(point.model for point in self.points))

    def further_handles(self) -> "Sequence[Artist]":
        """Return the handles of filled and open markers."""
        return significance_handles()

    def draw(self, axes: "Axes") -> None:
        """Draw a point with its intervals per category and model."""
        _draw_ground(axes)
        for position, model in enumerate(self._models):
            _draw_model(axes, [point for point in self.points if point.model == model], position, model)
        output = "answer" if self.modes == "answers" else "action"
        where = "in the backbone" if self.stream == "backbone" else f"where the {output} is made"
        axes.set_xlabel(f"best held-out probe {where} (%)", fontsize=9)

    def finish(self, figure: "Figure", grid: "Sequence[Axes]") -> None:
        """Add the legend, and settle the layout: names need the points' final places."""
        super().finish(figure, grid)
        figure.draw_without_rendering()

    def annotate(self) -> None:
        """Write names near their points."""
        assert self.ax_ is not None
        words = [title_of(point.category) for point in self.points]
        inks = [darker(series(self._models.index(point.model)).colour) for point in self.points]
        points = [(100 * point.accuracy, 100 * point.sr) for point in self.points]
        bars = [ends for point in self.points for ends in _bars(point)]
        # `place_labels` knows level and upright lines: the diagonal is a stair of short ones.
        diagonal = [((step, step), (step + 1, step + 1)) for step in range(100)]
        guessing = [((0, 50), (100, 50)), ((50, 0), (50, 100))]
        place_labels(self.ax_, points, words, inks, [*bars, *diagonal, *guessing])


def _point(row: RetentionRow, stream: str) -> GapPoint | None:
    part = row.backbone if stream == "backbone" else row.action
    if part.score is None or row.success.sr is None or row.success.ci is None:
        return None
    return GapPoint(
        model_name(row), row.category, part.score, part.ci, row.success.sr, row.success.ci, part.has_signal
    )


def _draw_ground(axes: "Axes") -> None:
    axes.fill_between([0, 100], [0, 100], [0, 0], color="0.955", lw=0, zorder=0)
    axes.plot([0, 100], [0, 100], color="0.45", lw=1, zorder=1)
    for draw in (axes.axvline, axes.axhline):
        draw(50, color="0.45", lw=0.8, ls="--", zorder=1)
    # Below the diagonal where accuracies are far below chance: points are rare there.
    axes.text(
        6, 4, "more decodable than success shows", va="top", rotation=45, rotation_mode="anchor",
        transform_rotates_text=True, fontsize=8, style="italic", color="0.35",
    )  # fmt: skip
    axes.text(0.5, 50.5, "guessing", fontsize=7, color="0.35")
    axes.text(50.5, 100, "chance", fontsize=7, color="0.35", rotation=90, va="top")
    axes.set_xlim(-2, 102)
    axes.set_ylim(-2, 102)
    axes.set_aspect("equal")


def _draw_model(axes: "Axes", points: Sequence[GapPoint], position: int, model: str) -> None:
    line = series(position)
    accuracies, rates = [100 * point.accuracy for point in points], [100 * point.sr for point in points]
    level = np.transpose([_ends(point.accuracy, point.accuracy_ci) for point in points])
    upright = np.transpose([_ends(point.sr, point.sr_ci) for point in points])
    draw_intervals(axes, accuracies, rates, line.colour, upright, level, is_faint=True)
    for filled in (True, False):
        of_marker = [point for point in points if point.significant == filled]
        axes.plot(
            [100 * point.accuracy for point in of_marker], [100 * point.sr for point in of_marker], ls="none",
            marker=line.marker, ms=6, color=line.colour, mfc=line.colour if filled else "white",
            label=model if filled else None, zorder=3,
        )  # fmt: skip


def _bars(point: GapPoint) -> "list[tuple[tuple[float, float], tuple[float, float]]]":
    """Return the ends of a point's error bars, in percent."""
    x, y = 100 * point.accuracy, 100 * point.sr
    (left, right), (low, high) = _ends(point.accuracy, point.accuracy_ci), _ends(point.sr, point.sr_ci)
    bars = [((left, y), (right, y)), ((x, low), (x, high))]
    return [ends for ends in bars if np.isfinite(ends).all()]


def _ends(value: float, limits: Limits | None) -> tuple[float, float]:
    """Return the ends of a value's interval in percent, with the value between them; NaN without two ends."""
    if limits is None or limits[0] is None or limits[1] is None:
        return nan, nan
    return 100 * min(value, limits[0]), 100 * max(value, limits[1])


_DOES: dict[Modes, str] = {"acts": "succeeds", "answers": "says it", "both": "succeeds or says it"}


@in_report(2)
def gap_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield a figure of all probed runs with a success rate."""
    acted = [row for row in source.table.rows if row.success.sr is not None]
    modes = modes_of(acted)
    if any(row.backbone.score is not None for row in acted):
        answers = modes == "answers"
        yield ReportFigure(
            "knowledge-action", f"Knowledge and {'answers' if answers else 'action'}", "retention",
            "Each point is one category: how well the answer can be read inside the model (across) and how often "
            f"the model {_DOES[modes]} (up). Far below the line, more can be read than "
            f"{'the answers show' if answers else 'success shows'}.",
            None, partial(figure_of, KnowledgeActionDisplay.from_table, source.table),
        )  # fmt: skip
