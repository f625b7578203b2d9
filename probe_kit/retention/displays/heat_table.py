"""Tables of numbers on heat colours, as the paper prints them: a model per row, a category per column."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from textwrap import fill
from typing import TYPE_CHECKING, ClassVar, Self

from probe_kit._tables.content import HEAT, heat_colour
from probe_kit.errors import UsageError
from probe_kit.retention.behaviour import Regime
from probe_kit.retention.columns.text import RATE, Modes, model_name, modes_of, once_per_category, title_of
from probe_kit.retention.displays.base.display import Display
from probe_kit.retention.displays.base.provenance_line import ProvenanceLine
from probe_kit.retention.displays.base.report_figure import FigureSource, ReportFigure, figure_of
from probe_kit.retention.displays.base.style import axes_for, caption, legend_above
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.retention.table import RetentionTable

if TYPE_CHECKING:
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


@dataclass
class HeatTableDisplay(Display):
    """A table drawn as a figure; the numbers are `cells[row][column].values`.

    rows, columns: their names. parts: names of the values side by side in a cell. certificates: one per row.
    rule_words: what the title says of the outcome rule.
    """

    rows: tuple[str, ...]
    columns: tuple[str, ...]
    cells: tuple[tuple[Cell, ...], ...]
    certificates: tuple[ProvenanceLine, ...]
    parts: ClassVar[tuple[str, ...]] = ("",)
    title = ""
    note = ""
    notes: ClassVar[Mapping[Modes, str]] = {}
    scale: ClassVar[float] = 100.0
    digits: ClassVar[int] = 1
    rule_words: str = ""
    ax_: "Axes | None" = field(default=None, init=False, repr=False)

    @classmethod
    def _of_behaviour(cls, table: RetentionTable, cell: Callable[[RetentionRow], Cell]) -> Self:
        """Return a display of success rates, which belong to an outcome rule."""
        rows = once_per_category(table.all_rows)
        display = cls._of(rows, cell)
        modes, acted = modes_of(rows), [row for row in rows if row.run.mode == "acts"]
        display.title = cls.title.replace(RATE["acts"], RATE[modes])
        display.note = cls.notes.get(modes, cls.note)
        rules = ", ".join(dict.fromkeys(row.rules.rule for row in acted))
        display.rule_words = f", outcome rule {rules}" if acted else ""
        return display

    @classmethod
    def _of(cls, rows: Sequence[RetentionRow], cell: Callable[[RetentionRow], Cell]) -> Self:
        """One line per run and view, one column per category of any of them."""
        if not rows:
            raise UsageError(f"{cls.title}: the table has no rows to show")
        lines: dict[tuple[str | None, str, str | None], dict[str, RetentionRow]] = {}
        for row in rows:
            lines.setdefault((row.group, row.run.location, row.view), {})[row.category] = row
        columns = tuple(dict.fromkeys(row.category for row in rows))
        columns = (*(name for name in columns if name != "mean"), *(["mean"] if "mean" in columns else []))
        blank = Cell((None,) * len(cls.parts))
        return cls(
            rows=tuple(_line_name(line, rows) for line in lines.values()),
            columns=columns,
            cells=tuple(
                tuple(cell(line[name]) if name in line else blank for name in columns) for line in lines.values()
            ),
            certificates=tuple(ProvenanceLine.of_row(list(line.values())[-1]) for line in lines.values()),
        )

    def plot(self, ax: "Axes | None" = None) -> Self:
        """Draw on `ax`, or on a figure of its own with the key of colours and captions."""
        width = _CELL_WIDTH * len(self.columns) + _NAME_WIDTH * max(map(len, self.rows)) + 0.3
        height = _ROW_HEIGHT * (len(self.rows) + 1.5) + 0.9
        axes, figure = axes_for(ax, max(6.2, width), height)
        for number, line in enumerate(self.cells):
            for column, cell in enumerate(line):
                self._draw_cell(axes, column, number, cell)
        self._draw_names(axes)
        if figure is None:
            axes.set_title(self.title + self.rule_words, fontsize=10, loc="left", pad=34)
        else:
            legend_above(figure, self._key(), f"{self.title}{self.rule_words}\n{self.note}")
        caption(figure, *self.certificates)
        self.ax_ = axes
        return self

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
        """The colours and the numbers that they stand for."""
        from matplotlib.patches import Patch

        bounds = [0.0, *(bound for bound, _, _ in HEAT[:-1])]
        labels = [f"{self.scale * bound:g}–{self.scale * (bound + 0.2):g}" for bound in bounds]
        labels[0], labels[-1] = f"< {self.scale * 0.2:g}", f"≥ {self.scale * 0.8:g}"
        return [Patch(fc=f"#{rgb}", label=label) for (_, _, rgb), label in zip(HEAT, labels, strict=True)]


class SuccessTableDisplay(HeatTableDisplay):
    """Success rate in percent by model and category; bold above 0.5 + Δ."""

    title = "Success rate (%)"
    note = "bold: more than guessing explains, items as the unit"

    @classmethod
    def from_table(cls, table: RetentionTable) -> Self:
        """Read the retention table of any runs. Raises UsageError if it is empty."""
        return cls._of_behaviour(
            table, lambda row: Cell((row.success.sr,), row.success.regime == Regime.KNOWLEDGE)
        )


class SideTableDisplay(HeatTableDisplay):
    """Success rate in percent where the correct picture lay left | right (the paper's L/R table)."""

    title = "Success rate (%) where the correct picture is left | right"
    digits = 0
    note = "equal halves: no side is favoured; one blue, one pale: the policy goes to a side, not to an answer"
    notes: ClassVar[Mapping[Modes, str]] = {
        "answers": "equal halves: no side is favoured; one blue, one pale: a side is named, whatever the question",
        "both": "equal halves: no side is favoured; one blue, one pale: a side is chosen, whatever the question",
    }
    parts = ("left", "right")

    @classmethod
    def from_table(cls, table: RetentionTable) -> Self:
        """Read the retention table of any runs. Raises UsageError if it is empty."""
        return cls._of_behaviour(table, lambda row: Cell((row.success.sr_left, row.success.sr_right)))


class RetentionTableDisplay(HeatTableDisplay):
    """Bounded retention and the published ratio by model and category; empty where the backbone knows nothing."""

    title = "Retention | published ratio"
    note = "dash: the backbone's signal is not shown, so the ratio has no meaning"
    parts = ("retention", "published")
    scale, digits = 1.0, 2

    @classmethod
    def from_table(cls, table: RetentionTable) -> Self:
        """Read a retention table with probes. Raises UsageError if no run was probed."""

        def cell(row: RetentionRow) -> Cell:
            values = (row.retention.value, row.retention.published) if row.retention.defined else (None, None)
            return Cell(values)

        return cls._of([row for row in table.all_rows if row.view is not None], cell)


def _line_name(line: dict[str, RetentionRow], rows: Sequence[RetentionRow]) -> str:
    row = next(iter(line.values()))
    views = {other.view for other in rows if other.view is not None}
    return f"{model_name(row)}, {row.view}" if len(views) > 1 and row.view else model_name(row)


PLACE = 1
"""Of its figures in the report."""


def report_figures(source: FigureSource) -> Iterator[ReportFigure]:
    """The figures that a report of these runs shows."""
    table = source.table
    acted = [row for row in table.rows if row.success.sr is not None]
    modes = modes_of(acted)
    displays: list[tuple[type[SuccessTableDisplay | SideTableDisplay | RetentionTableDisplay], str, str, str]] = []
    if acted:
        displays.append((SuccessTableDisplay, "success", RATE[modes], "behaviour"))
        displays.append((SideTableDisplay, "sides", f"{RATE[modes]} by side", "behaviour"))
    if any(row.retention.published is not None for row in table.rows):
        displays.append((RetentionTableDisplay, "retention", "Retention", "retention"))
    for display, name, title, subject in displays:
        note = display.notes.get(modes, display.note)
        yield ReportFigure(
            name, title, subject, note, None, partial(_drawn, display, table), is_table=True,
            is_detail=display is SideTableDisplay,
        )  # fmt: skip


def _drawn(
    display: type[SuccessTableDisplay | SideTableDisplay | RetentionTableDisplay], table: RetentionTable
) -> "Figure":
    return figure_of(display.from_table(table))
