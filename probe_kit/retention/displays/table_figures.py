"""Figures of a whole table: numbers on heat colours, and success against probe accuracy."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from textwrap import fill
from typing import TYPE_CHECKING, ClassVar, Literal, Self

from probe_kit._tables.content import HEAT, heat_colour
from probe_kit.errors import UsageError
from probe_kit.retention.behaviour import Regime
from probe_kit.retention.columns.tables import once_per_category
from probe_kit.retention.columns.text import RATE, Modes, model_name, modes_of, title_of
from probe_kit.retention.displays.display import (
    Display,
    ProvenanceLine,
    darker,
    legend_above,
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
    from matplotlib.patches import Patch


_CELL_WIDTH, _ROW_HEIGHT = 0.66, 0.36  # inches
_NAME_WIDTH = 0.085  # inches per character of a model's name
_EMPTY = "#F4F4F4"


@dataclass(frozen=True)
class Cell:
    """Values side by side, None where there is none, and whether they are printed bold."""

    values: tuple[float | None, ...]
    bold: bool = False


@dataclass(kw_only=True)
class HeatTableDisplay(Display):
    """A table drawn as a figure; the numbers are `cells[row][column].values`.

    The display has one certificate per row.

    Attributes:
        rows: Names of the rows.
        columns: Names of the columns.
        parts: Names of the values side by side in a cell.
    """

    rows: tuple[str, ...]
    columns: tuple[str, ...]
    cells: tuple[tuple[Cell, ...], ...]
    parts: ClassVar[tuple[str, ...]] = ("",)
    heading = ""
    note = ""
    is_framed: ClassVar = True
    title_size: ClassVar = 10
    notes: ClassVar[Mapping[Modes, str]] = {}
    scale: ClassVar[float] = 100.0
    digits: ClassVar[int] = 1

    @classmethod
    def _of_behaviour(cls, table: RetentionTable, cell: Callable[[RetentionRow], Cell]) -> Self:
        """Return a display of success rates, which belong to an outcome rule."""
        rows = once_per_category(table.all_rows)
        display = cls._of(rows, cell)
        modes, acted = modes_of(rows), [row for row in rows if row.run.mode == "acts"]
        display.note = cls.notes.get(modes, cls.note)
        rules = ", ".join(dict.fromkeys(row.rules.rule for row in acted))
        display.title = cls.heading.replace(RATE["acts"], RATE[modes]) + f", outcome rule {rules}" * bool(acted)
        return display

    @classmethod
    def _of(cls, rows: Sequence[RetentionRow], cell: Callable[[RetentionRow], Cell]) -> Self:
        """Return a display with one line per run and view, one column per category of any of them."""
        if not rows:
            raise UsageError(f"{cls.heading}: the table has no rows to show")
        lines: dict[tuple[str | None, str, str | None], dict[str, RetentionRow]] = {}
        for row in rows:
            lines.setdefault((row.group, row.run.location, row.view), {})[row.category] = row
        columns = tuple(dict.fromkeys(row.category for row in rows))
        columns = (*(name for name in columns if name != "mean"), *(["mean"] if "mean" in columns else []))
        blank = Cell((None,) * len(cls.parts))
        names = tuple(_line_name(line, rows) for line in lines.values())
        width = _CELL_WIDTH * len(columns) + _NAME_WIDTH * max(map(len, names)) + 0.3
        return cls(
            title=cls.heading,
            figure_size=(max(6.2, width), _ROW_HEIGHT * (len(names) + 1.5) - 0.2),
            rows=names,
            columns=columns,
            cells=tuple(
                tuple(cell(line[name]) if name in line else blank for name in columns) for line in lines.values()
            ),
            certificates=tuple(ProvenanceLine.of_row(list(line.values())[-1]) for line in lines.values()),
        )

    def draw(self, axes: "Axes") -> None:
        """Draw the cells and the names of rows and columns."""
        for number, line in enumerate(self.cells):
            for column, cell in enumerate(line):
                self._draw_cell(axes, column, number, cell)
        self._draw_names(axes)

    def finish(self, figure: "Figure", grid: "Sequence[Axes]") -> None:
        """Add the key of colours below the title, which may be wider than the table."""
        grid[0].set_title("", loc="left")
        legend_above(figure, self._key(), f"{self.title}\n{self.note}")

    def _draw_cell(self, axes: "Axes", column: int, number: int, cell: Cell) -> None:
        from matplotlib.patches import Rectangle

        share = 1 / len(cell.values)
        for part, value in enumerate(cell.values):
            start = column + part * share
            fill_with = _EMPTY if value is None else heat_colour(value)
            axes.add_patch(Rectangle((start, number), share, 1, fc=fill_with, ec="white", lw=0.6))
            text = "–" if value is None else f"{self.scale * value:.{self.digits}f}"
            weight = "bold" if cell.bold else "normal"
            axes.text(start + share / 2, number + 0.52, text, ha="center", va="center", fontsize=8, weight=weight)
        axes.add_patch(Rectangle((column, number), 1, 1, fill=False, ec="white", lw=2.2))

    def _draw_names(self, axes: "Axes") -> None:
        axes.set_xlim(0, len(self.columns))
        axes.set_ylim(len(self.rows), 0)
        names = [fill(title_of(name), 9, break_long_words=False) for name in self.columns]
        axes.set_xticks([column + 0.5 for column in range(len(names))], names, fontsize=8)
        axes.set_yticks([number + 0.5 for number in range(len(self.rows))], list(self.rows), fontsize=8)
        axes.xaxis.tick_top()
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        if self.columns[-1] == "mean" and len(self.columns) > 1:
            axes.axvline(len(self.columns) - 1, color="0.35", lw=0.9)

    def _key(self) -> "list[Patch]":
        """Return the colours and the numbers that they stand for."""
        from matplotlib.patches import Patch

        bounds = [0.0, *(bound for bound, _, _ in HEAT[:-1])]
        labels = [f"{self.scale * bound:g}–{self.scale * (bound + 0.2):g}" for bound in bounds]
        labels[0], labels[-1] = f"< {self.scale * 0.2:g}", f"≥ {self.scale * 0.8:g}"
        return [Patch(fc=f"#{rgb}", label=label) for (_, _, rgb), label in zip(HEAT, labels, strict=True)]


class SuccessTableDisplay(HeatTableDisplay):
    """Success rate in percent by model and category; bold above 0.5 + Δ."""

    heading = "Success rate (%)"
    note = "bold: more than guessing explains, items as the unit"

    @classmethod
    def from_table(cls, table: RetentionTable) -> Self:
        """Read the retention table of any runs.

        Raises:
            UsageError: If it is empty.
        """
        return cls._of_behaviour(
            table, lambda row: Cell((row.success.sr,), row.success.regime == Regime.KNOWLEDGE)
        )


class SideTableDisplay(HeatTableDisplay):
    """Success rate in percent where the correct picture lay left | right (the paper's L/R table)."""

    heading = "Success rate (%) where the correct picture is left | right"
    digits = 0
    note = "equal halves: no side is favoured; one blue, one pale: the policy goes to a side, not to an answer"
    notes: ClassVar[Mapping[Modes, str]] = {
        "answers": "equal halves: no side is favoured; one blue, one pale: a side is named, whatever the question",
        "both": "equal halves: no side is favoured; one blue, one pale: a side is chosen, whatever the question",
    }
    parts = ("left", "right")

    @classmethod
    def from_table(cls, table: RetentionTable) -> Self:
        """Read the retention table of any runs.

        Raises:
            UsageError: If it is empty.
        """
        return cls._of_behaviour(table, lambda row: Cell((row.success.sr_left, row.success.sr_right)))


class RetentionTableDisplay(HeatTableDisplay):
    """Bounded retention and the published ratio by model and category; empty where the backbone knows nothing."""

    heading = "Retention | published ratio"
    note = "dash: the backbone's signal is not shown, so the ratio has no meaning"
    parts = ("retention", "published")
    scale, digits = 1.0, 2

    @classmethod
    def from_table(cls, table: RetentionTable) -> Self:
        """Read a retention table with probes.

        Raises:
            UsageError: If no run was probed.
        """

        def cell(row: RetentionRow) -> Cell:
            values = (row.retention.value, row.retention.published) if row.retention.defined else (None, None)
            return Cell(values)

        return cls._of([row for row in table.all_rows if row.view is not None], cell)


def _line_name(line: dict[str, RetentionRow], rows: Sequence[RetentionRow]) -> str:
    row = next(iter(line.values()))
    views = {other.view for other in rows if other.view is not None}
    return f"{model_name(row)}, {row.view}" if len(views) > 1 and row.view else model_name(row)


@in_report(1)
def table_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """Yield the tables of success, sides and retention, as far as the rows have such numbers."""
    table = source.table
    acted = [row for row in table.rows if row.success.sr is not None]
    modes = modes_of(acted)
    displays: list[tuple[type[HeatTableDisplay], Callable[[RetentionTable], HeatTableDisplay], str, str, str]] = []
    if acted:
        sides, by_side = SideTableDisplay, f"{RATE[modes]} by side"
        displays.append((SuccessTableDisplay, SuccessTableDisplay.from_table, "success", RATE[modes], "behaviour"))
        displays.append((sides, sides.from_table, "sides", by_side, "behaviour"))
    if any(row.retention.published is not None for row in table.rows):
        ratios = RetentionTableDisplay
        displays.append((ratios, ratios.from_table, "retention", "Retention", "retention"))
    for display, read, name, title, subject in displays:
        yield ReportFigure(
            name, title, subject, display.notes.get(modes, display.note), None, partial(figure_of, read, table),
            is_table=True, is_detail=display is SideTableDisplay,
        )  # fmt: skip


# -- success against what probes read ----------------------------------------------------------------------------

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
        reach, box = min(boxes, key=lambda of: (_covered(of[1], occupied) + _outside(of[1], frame), of[0]))
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
    return (box[2] - box[0]) * (box[3] - box[1]) - _covered(box, [frame])


def _covered(box: Box, boxes: Sequence[Box]) -> float:
    """Return the area that `box` shares with others, in square points."""
    return sum(
        max(0.0, min(box[2], other[2]) - max(box[0], other[0]))
        * max(0.0, min(box[3], other[3]) - max(box[1], other[1]))
        for other in boxes
    )


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
    """Return the ends of a point's error bars, in percent."""
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
