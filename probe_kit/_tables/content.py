"""The content of a table, which renderers read: headings, rows of cells, notes.

A renderer knows no subject: a cell says what is bold, red, coloured or sorted, and a heading says what it means. A
cell holds its value, the interval and the format; their text is made when a renderer asks for it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self

from probe_kit._tables.numbers import NONE, Limits, is_missing, limits_text, plain

Number = Mapping[str, Any]
"""A number behind a table with what it describes, or the numbers of a row."""


@dataclass(frozen=True)
class Cell:
    """A value and its format, and how formats that can show it look.

    Attributes:
        value: A number, or a text; None where there is neither.
        write: The format of the value and of the ends of its interval; it says what stands in place of None.
        interval: The 95 % interval of the value; None for a cell without one.
        after: A text behind the value, such as a mark or a number that belongs to it.
        write_ends: The format of the ends where the interval is of another number than the value, such as that of
            a difference behind its p.
        sort: The key by which a page sorts, the value by default.
        heat: A share that colors the ground.
        strong: Whether the text is bold.
        alarm: Whether the text is red.
        note: A text that a page shows if the pointer is on the cell.
    """

    value: float | str | None
    write: Callable[[Any], str] = plain
    interval: Limits | None = None
    after: str = ""
    write_ends: Callable[[Any], str] | None = None
    sort: float | str | None = None
    heat: float | None = None
    strong: bool = False
    alarm: bool = False
    note: str = ""

    @property
    def value_text(self) -> str:
        """The text without the interval."""
        return self.write(self.value) + self.after

    @property
    def interval_text(self) -> str:
        """The interval in square brackets; empty without one."""
        if self.interval is None or isinstance(self.value, str):
            return ""
        if is_missing(self.value) and self.write_ends is None:
            return ""
        return limits_text(self.interval, self.write_ends or self.write)

    @property
    def text(self) -> str:
        """The value, its interval, and what follows."""
        limits = self.interval_text
        return f"{self.write(self.value)} {limits}{self.after}" if limits else self.value_text

    @property
    def is_text(self) -> bool:
        """Whether it holds a text, and neither a number nor a sign that there is none."""
        return isinstance(self.value, str) and self.value not in ("", NONE)


@dataclass(frozen=True)
class FixedText:
    """A format that writes the same text for every value. Formats of the same text are equal."""

    text: str

    def __call__(self, _: object) -> str:
        """Return the text."""
        return self.text


def absent(text: str) -> Cell:
    """Return a cell with a text in place of a number, such as `n/a`, which is aligned like numbers."""
    return Cell(None, FixedText(text))


Cells = tuple[Cell | str, ...]
"""The cells of a line; a text is a cell with nothing else."""


@dataclass(frozen=True)
class Heading:
    """The text over a column.

    Attributes:
        help: Its entry in a glossary; empty for none.
        group: A name over adjoining columns; empty for none.
        is_detail: Whether the column needs room, and is left out of terminals and LaTeX.
        term: Its entry in the legend below the table, `name: meaning`; empty for none.
    """

    text: str
    help: str = ""
    group: str = ""
    is_detail: bool = False
    term: str = ""


@dataclass(frozen=True)
class TableRow:
    """The cells of a line. Pages keep means and differences below the others when they sort.

    Attributes:
        is_mean: Whether the row averages others.
        is_difference: Whether the row compares others.
    """

    cells: tuple[Cell, ...]
    is_mean: bool = False
    is_difference: bool = False


@dataclass(frozen=True)
class Legend:
    """The parts of a legend beside the terms of the columns that are shown.

    Attributes:
        before: Remarks in front of the terms.
        marks: The meaning of signs that cells have, by sign; one that no cell has is left out.
        after: Remarks behind all of them.
    """

    before: tuple[str, ...] = ()
    marks: Mapping[str, str] = field(default_factory=dict)
    after: tuple[str, ...] = ()


@dataclass(frozen=True)
class Content:
    """The part of a table that a renderer reads: its text, and the numbers behind it.

    Attributes:
        names: The number of first columns that name the rows.
        notes: Sentences below the legend, which need no capital letter and no period.
        numbers: An object per row or per number, shares in [0, 1], None where unknown.
        is_partial: Whether runs are missing that could be played; a note names them.
        overflow: The way in which a terminal shows columns that do not fit. `split`: in further tables. `leave
            out`: by name only. `fold`: first with intervals below their values. `wrap`: with wrapped text, for
            columns of words.
        legend: Remarks and the meaning of marks, which are shown with the terms of the columns.
    """

    title: str
    headings: tuple[Heading, ...]
    rows: tuple[TableRow, ...]
    names: int = 1
    notes: tuple[str, ...] = ()
    numbers: tuple[Number, ...] = ()
    is_partial: bool = False
    overflow: Literal["split", "leave out", "fold", "wrap"] = "split"
    legend: Legend = field(default_factory=Legend)

    @classmethod
    def of(
        cls,
        title: str,
        headings: Sequence[Heading | str],
        rows: Sequence[Sequence[Cell | str]],
        *,
        mean: str | None = None,
        notes: Sequence[str] = (),
        **more: Any,
    ) -> Self:
        """Return a table.

        Args:
            title: The title, without a period.
            headings: A heading per column; a text is a heading with nothing else.
            rows: The cells by row; a text is a cell with nothing else.
            mean: The name of the rows that average others; None if no row does.
            notes: Sentences below the table; empty ones are left out.
            **more: Further fields of the table.
        """
        names = int(more.get("names", 1))
        cells = [tuple(cell if isinstance(cell, Cell) else Cell(cell) for cell in row) for row in rows]
        lines = [TableRow(row, mean is not None and mean in [cell.text for cell in row[:names]]) for row in cells]
        heads = tuple(heading if isinstance(heading, Heading) else Heading(heading) for heading in headings)
        return cls(title, heads, tuple(lines), notes=tuple(filter(None, notes)), **more)

    def with_remarks(self, remarks: Sequence[str]) -> Self:
        """Return the table with more remarks at the end of its legend."""
        return replace(self, legend=replace(self.legend, after=(*self.legend.after, *remarks)))

    def with_notes(self, sentences: Sequence[str]) -> Self:
        """Return the table with more sentences below it."""
        return replace(self, notes=(*self.notes, *sentences))

    @property
    def columns(self) -> tuple[str, ...]:
        """The headings as text."""
        return tuple(heading.text for heading in self.headings)

    @property
    def full_headings(self) -> tuple[str, ...]:
        """The headings as text, with the name over them where two columns have one heading."""
        texts = self.columns
        return tuple(
            f"{heading.group} {heading.text}" if heading.group and texts.count(heading.text) > 1 else heading.text
            for heading in self.headings
        )

    @property
    def texts(self) -> tuple[tuple[str, ...], ...]:
        """The cells as text."""
        return tuple(tuple(cell.text for cell in row.cells) for row in self.rows)

    @property
    def all_notes(self) -> tuple[str, ...]:
        """The legend, where there is anything to explain, and the notes."""
        texts = [text for row in self.texts for text in row]
        marks = [mark for mark in self.legend.marks if any(mark in text for text in texts)]
        parts = (
            *self.legend.before,
            *(heading.term for heading in self.headings),
            *(f"{mark}: {self.legend.marks[mark]}" for mark in marks),
            *self.legend.after,
        )
        return tuple(filter(None, ("; ".join(filter(None, parts)), *self.notes)))

    @property
    def sentences(self) -> tuple[str, ...]:
        """The legend and the notes as sentences."""
        return tuple(map(_sentence, self.all_notes))

    @property
    def are_numeric(self) -> tuple[bool, ...]:
        """A flag per column: whether it holds numbers, which are aligned to the right."""
        columns = [*zip(*(row.cells for row in self.rows), strict=True)] or [()] * len(self.headings)
        return tuple(
            at >= self.names and any(cell.text for cell in cells) and not any(cell.is_text for cell in cells)
            for at, cells in enumerate(columns)
        )

    @property
    def _by_column(self) -> list[tuple[str, ...]]:
        """The cells of each column as text."""
        return [*zip(*self.texts, strict=True)] or [()] * len(self.headings)

    def only(self, columns: Sequence[int]) -> Self:
        """Return the table with some of its columns, those that name the rows first."""
        rows = tuple(replace(row, cells=tuple(row.cells[at] for at in columns)) for row in self.rows)
        headings = tuple(self.headings[at] for at in columns)
        return replace(self, headings=headings, rows=rows, names=sum(at < self.names for at in columns))

    def filled(self, *empty: str) -> Self:
        """Return the table without columns in which every row has a dash, nothing, or one of the texts `empty`."""
        return self.only(
            [
                at
                for at, texts in enumerate(self._by_column)
                if at < self.names or any(text not in (NONE, "", *empty) for text in texts)
            ]
        )

    def details(self, are_details: bool) -> Self | None:
        """Return the columns that need room, or those that do not; None where the table has none of them."""
        columns = [
            at for at, heading in enumerate(self.headings) if at >= self.names and heading.is_detail == are_details
        ]
        return self.only([*range(self.names), *columns]) if columns else None


def group_headings(*groups: tuple[str, Sequence[str]]) -> tuple[Heading, ...]:
    """Return headings under names over adjoining columns."""
    return tuple(Heading(text, group=group) for group, texts in groups for text in texts)


def _sentence(note: str) -> str:
    """Return a note as a sentence; one that is a sentence may begin with a name, which stays as it is."""
    if note.endswith("."):
        return note
    start = note if note.startswith("n/a") else f"{note[:1].upper()}{note[1:]}"
    return f"{start}."


# -- heat -----------------------------------------------------------------------------------------------------

HEAT = (
    (0.2, "pkheat1", "FFF4CF"),
    (0.4, "pkheat2", "F2DC97"),
    (0.6, "pkheat3", "CFCDB0"),
    (0.8, "pkheat4", "9FBAD0"),
    (float("inf"), "pkheat5", "6FA3DA"),
)
"""The upper bound of retention, color name and RGB, from lost (pale yellow) to kept (blue).

Lightness alone orders them, so that they differ in grey and for every kind of color vision.
"""


def heat_colour(value: float) -> str:
    """Return the color `#RRGGBB` of a share or ratio, from lost (pale yellow) to kept (blue)."""
    return f"#{next(rgb for bound, _, rgb in HEAT if value < bound)}"


def heat_key() -> list[tuple[str, str]]:
    """Return each color with the shares it stands for, in words, from low to high."""
    bounds = [0.0, *(bound for bound, _, _ in HEAT[:-1])]
    words = [f"{100 * bound:.0f} to {100 * (bound + 0.2):.0f} %" for bound in bounds]
    words[0], words[-1] = "below 20 %", "80 % and more"
    return [(f"#{rgb}", text) for (_, _, rgb), text in zip(HEAT, words, strict=True)]
