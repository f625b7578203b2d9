"""Console tables that never truncate numbers: columns that do not fit move below, or are left out by name."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.table import Table

GAP = 2
"""Blanks between columns."""
_INDENT = "  "
"""Of a row's name below that of its section."""


@dataclass(frozen=True)
class Cell:
    """Text in a style of rich, such as `bold red`; a text of several lines keeps them."""

    text: str
    style: str = ""

    @property
    def width(self) -> int:
        """Of its widest line."""
        from rich.cells import cell_len

        return max(map(cell_len, self.text.split("\n")), default=0)


@dataclass(frozen=True)
class Part:
    """Columns that answer one question and stay together where they can.

    title: of their table where they get one of their own. headings: one per column; rows: one cell per column.
    """

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def only(self, columns: Sequence[int]) -> "Part":
        """The same with some of the columns."""
        return Part(
            self.title,
            tuple(self.headings[column] for column in columns),
            tuple(tuple(row[column] for column in columns) for row in self.rows),
        )

    @property
    def width(self) -> int:
        """Of all columns with the gaps before them."""
        return sum(
            GAP + max(Cell(heading).width, *(row[column].width for row in self.rows), 0)
            for column, heading in enumerate(self.headings)
        )


@dataclass(frozen=True)
class ResponsiveTable:
    """A table that is as wide as the console allows: one, or several that each repeat the names of the rows.

    A row that has nothing to say in one of several tables, all its cells there being empty, is left out of it.

    names: of the rows, under the heading `name`; styles: one per row. caption: under the last table. splits:
    whether columns that do not fit stand in further tables; else the caption names them. sections: none, or one
    per row: rows of one section stand below its name.
    """

    title: str
    caption: str
    name: str
    names: tuple[str, ...]
    styles: tuple[str, ...]
    parts: tuple[Part, ...]
    splits: bool = True
    sections: tuple[str, ...] = ()

    @property
    def width(self) -> int:
        """Columns of a console on which it is one table."""
        return self._name_width + sum(part.width for part in self.parts)

    @property
    def _name_width(self) -> int:
        return max(Cell(name).width for name in (self.name, *self._shown_names))

    @property
    def _shown_names(self) -> tuple[str, ...]:
        return tuple(f"{_INDENT if self.sections else ''}{name}" for name in self.names)

    def __rich_console__(self, _: "Console", options: "ConsoleOptions") -> "Iterator[RenderableType]":
        from rich.text import Text

        shown = self if self.splits else self._fitted(options.max_width)
        yield Text(self.title, style="italic")
        yield from shown._tables(options.max_width)
        if shown.caption:
            yield Text(shown.caption, style="dim")
        yield Text()

    def _fitted(self, width: int) -> "ResponsiveTable":
        """One table with the columns that fit, the first ones first; the caption names the others."""
        room, parts, missing = width - self._name_width, [], []
        for part in self.parts:
            kept = []
            for column, heading in enumerate(part.headings):
                if (needed := part.only([column]).width) <= room:
                    kept.append(column)
                    room -= needed
                else:
                    missing.append(heading)
            parts.append(part.only(kept))
        if not any(part.headings for part in parts):
            return self
        left_out = f"with --details or more room: {', '.join(dict.fromkeys(missing))}" if missing else ""
        caption = "; ".join(filter(None, (self.caption, left_out)))
        return replace(self, parts=tuple(part for part in parts if part.headings), caption=caption)

    def _tables(self, width: int) -> "Iterator[Table | RenderableType]":
        from rich.text import Text

        room = width - self._name_width
        if any(part.only([column]).width > room for part in self.parts for column in range(len(part.headings))):
            yield from self._lists()
            return
        shown = [one for part in self.parts for one in _split(part, room)]
        while shown:
            count = max(n for n in range(1, len(shown) + 1) if n == 1 or sum(p.width for p in shown[:n]) <= room)
            if count < len(shown) or len(shown) < len(self.parts):
                yield Text(f"\n{' · '.join(dict.fromkeys(part.title for part in shown[:count]))}")
            yield from self._table(shown[:count])
            shown = shown[count:]

    def _table(self, parts: Sequence[Part]) -> "Iterator[RenderableType]":
        from rich.text import Text

        rows = [
            (section, name, style, [cell for part in parts for cell in part.rows[number]])
            for number, (section, name, style) in enumerate(
                zip(self.sections or ("",) * len(self.names), self._shown_names, self.styles, strict=True)
            )
        ]
        rows = [row for row in rows if any(cell.text for cell in row[3])]
        table = self._columns(parts)
        if not self.sections:
            _fill(table, [row[1:] for row in rows])
            yield table
            return
        yield table
        for section, below in groupby(rows, key=lambda row: row[0]):
            yield Text(section, style="bold")
            table = self._columns(parts, heads=False)
            _fill(table, [row[1:] for row in below])
            yield table

    def _columns(self, parts: Sequence[Part], heads: bool = True) -> "Table":
        """An empty table, whose columns have the same width with and without their heads."""
        from rich.box import SIMPLE_HEAD
        from rich.table import Table

        table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False, show_header=heads)
        table.add_column(self.name, no_wrap=True, vertical="bottom", min_width=self._name_width)
        for part in parts:
            for column, heading in enumerate(part.headings):
                table.add_column(heading, no_wrap=True, min_width=part.only([column]).width - GAP)
        return table

    def _lists(self) -> "Iterator[RenderableType]":
        """A line per value, for consoles on which not even one column fits beside the names."""
        from rich.text import Text

        for number, (name, style) in enumerate(zip(self.names, self.styles, strict=True)):
            section = f"{self.sections[number]}: " if self.sections else ""
            yield Text(f"{section}{self.name} {name}", style=style or "underline")
            for part in self.parts:
                for heading, cell in zip(part.headings, part.rows[number], strict=True):
                    if not cell.text:
                        continue
                    yield Text(" ".join(f"{heading}:".split()), style="dim")
                    yield Text(f"  {cell.text}", style=cell.style, overflow="fold")


def _fill(table: "Table", rows: Iterable[tuple[str, str, Sequence[Cell]]]) -> None:
    """Add rows of a name, a style and cells. A name has the height of the first line of its cells."""
    from rich.text import Text

    for name, style, cells in rows:
        below = max((cell.text.count("\n") for cell in cells), default=0)
        table.add_row(
            Text(name + "\n" * below), *(Text(cell.text, style=cell.style) for cell in cells), style=style
        )


def _split(part: Part, room: int) -> Iterator[Part]:
    """The columns of a part in as few pieces as fit into `room`."""
    columns: list[int] = []
    for column in range(len(part.headings)):
        if columns and part.only([*columns, column]).width > room:
            yield part.only(columns)
            columns = []
        columns.append(column)
    yield part.only(columns)
