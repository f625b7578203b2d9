"""Tables on a console that never truncate numbers: columns that do not fit move below, or are left out by name."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby, pairwise
from typing import TYPE_CHECKING, Literal

from probe_kit._tables.content import Cell, Content, TableRow

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table as RichTable
    from rich.text import Text

GAP = 2
"""The blanks between columns."""
LEAST_TEXT = 12
"""The least columns of a console that a text is broken into."""
_INDENT = "  "
"""The indent of a row's name below that of its section."""


def lines(table: Content, width: int) -> "Iterator[RenderableType]":
    """Yield what a console of `width` columns shows: the title, one table or several, and the notes."""
    from rich.text import Text

    left_out: list[str] = []
    if table.overflow == "leave out":
        table, left_out = _fitting(table, width)
    elif table.overflow == "fold" and width_of(table) > width:
        folded = (replace(row, cells=tuple(map(_two_lines, row.cells))) for row in table.rows)
        table = replace(table, rows=tuple(folded))
    yield Text(table.title, style="italic")
    yield from (
        [_wrap_table(table)] if table.overflow == "wrap" and _can_wrap(table, width) else _tables(table, width)
    )
    notes = list(table.sentences)
    if left_out:
        notes.append(f"With --details or more room: {', '.join(left_out)}.")
    if notes:
        yield Text("\n".join(notes), style="dim")
    yield Text()


def _is_unbroken(table: Content, at: int) -> bool:
    """Whether the texts of a column are names or numbers, which are never broken."""
    has_letters = any(map(str.isalpha, "".join(text[at] for text in table.texts)))
    return at < table.names or (table.are_numeric[at] and not has_letters)


def _can_wrap(table: Content, width: int) -> bool:
    """Whether texts have room beside names and numbers, which rich would cut off without a sign."""
    needed = _column_widths(table)
    unbroken = [_is_unbroken(table, at) for at in range(len(needed))]
    least = (full if keep else min(full, GAP + LEAST_TEXT) for full, keep in zip(needed, unbroken, strict=True))
    return sum(least) - GAP <= width


def _wrap_table(table: Content) -> "RichTable":
    """Return one table whose texts are broken where they do not fit; names and numbers are not."""
    from rich.text import Text

    wrapped = _without_columns()
    for at, heading in enumerate(table.headings):
        unbroken = _is_unbroken(table, at)
        justify: Literal["left", "right"] = "right" if unbroken and at >= table.names else "left"
        wrapped.add_column(Text(heading.text), no_wrap=unbroken, overflow="fold", justify=justify)
    for row in table.rows:
        wrapped.add_row(*map(_text, row.cells), style=_style(row))
    return wrapped


def width_of(table: Content) -> int:
    """Return the columns of a console on which the table is one."""
    return _name_width(table) + sum(_column_widths(table)[table.names :])


def _two_lines(cell: Cell) -> Cell:
    """Return a cell with the interval below its value, and words broken at commas."""
    limits = cell.interval_text
    text = f"{cell.value_text}\n{limits}" if limits else cell.text.replace(", ", ",\n")
    return Cell(text, strong=cell.strong, alarm=cell.alarm)


def _fitting(table: Content, width: int) -> tuple[Content, list[str]]:
    """Return the table with the columns that fit, the first ones first, and the headings of the others."""
    room, fitting, left_out = width - _name_width(table), [], []
    needed = _column_widths(table)
    for at in range(table.names, len(table.headings)):
        if needed[at] <= room:
            fitting.append(at)
            room -= needed[at]
        else:
            left_out.append(table.headings[at].text)
    return (table.only([*range(table.names), *fitting]), left_out) if fitting else (table, [])


# -- names of rows ---------------------------------------------------------------------------------------------


def _sections(table: Content) -> list[str]:
    """Return the section of every row: its first name where names of the first column repeat, else nothing."""
    firsts = [row.cells[0].text for row in table.rows]
    is_divided = table.names > 1 and any(previous == other for previous, other in pairwise(firsts))
    return firsts if is_divided else [""] * len(firsts)


def _names(table: Content) -> list[str]:
    """Return the text before every row: its names, or below a section those after the first."""
    names = []
    for row, section in zip(table.rows, _sections(table), strict=True):
        texts = [cell.text for cell in row.cells[: table.names]]
        names.append(f"{_INDENT}{' · '.join(texts[1:])}" if section else " · ".join(texts))
    return names


def _name_heading(table: Content) -> str:
    return " · ".join(table.columns[: table.names])


def _name_width(table: Content) -> int:
    return max(map(_text_width, (_name_heading(table), *_names(table))))


def _text_width(text: str) -> int:
    from rich.cells import cell_len

    return max(map(cell_len, text.split("\n")), default=0)


def _column_widths(table: Content) -> list[int]:
    """Return the width of every column with the gap before it."""
    return [GAP + max(map(_text_width, column)) for column in zip(table.columns, *table.texts, strict=True)]


# -- tables ----------------------------------------------------------------------------------------------------


def _tables(table: Content, width: int) -> "Iterator[RenderableType]":
    """Yield one table, or several that each repeat the names of the rows; columns of one head stay together."""
    from rich.text import Text

    room, needed = width - _name_width(table), _column_widths(table)
    columns = range(table.names, len(table.headings))
    if any(needed[at] > room for at in columns):
        yield from _lists(table)
        return
    heads = [list(group) for _, group in groupby(columns, key=lambda at: table.headings[at].group)]
    blocks: list[list[int]] = []
    for piece in (piece for head in heads for piece in _pieces(head, needed, room)):
        if blocks and sum(needed[at] for at in (*blocks[-1], *piece)) <= room:
            blocks[-1] += piece
        else:
            blocks.append(list(piece))
    for block in blocks:
        if len(blocks) > 1:
            yield Text(f"\n{' · '.join(dict.fromkeys(table.headings[at].group for at in block))}".rstrip())
        yield from _table(table, block)


def _pieces(head: Sequence[int], needed: Sequence[int], room: int) -> Iterator[list[int]]:
    """Yield the columns below a head in as few pieces as fit into `room`."""
    columns: list[int] = []
    for at in head:
        if columns and sum(needed[column] for column in (*columns, at)) > room:
            yield columns
            columns = []
        columns.append(at)
    yield columns


def _table(table: Content, columns: Sequence[int]) -> "Iterator[RenderableType]":
    """Yield one table. A row whose cells in these columns are all empty is left out."""
    from rich.text import Text

    rows = [
        (section, name, row)
        for section, name, row in zip(_sections(table), _names(table), table.rows, strict=True)
        if any(row.cells[at].text for at in columns)
    ]
    is_divided = any(section for section, _, _ in rows)
    if is_divided:
        yield _empty(table, columns)
    for section, below in groupby(rows, key=lambda row: row[0]):
        if is_divided:
            yield Text(section, style="bold")
        part = _empty(table, columns, has_headings=not is_divided)
        for _, name, row in below:
            cells = [row.cells[at] for at in columns]
            height = max(cell.text.count("\n") for cell in cells)
            part.add_row(Text(name + "\n" * height), *map(_text, cells), style=_style(row))
        yield part


def _empty(table: Content, columns: Sequence[int], has_headings: bool = True) -> "RichTable":
    """Return a table without rows, whose columns have the same width with and without their headings."""
    from rich.text import Text

    needed, empty = _column_widths(table), _without_columns(has_headings)
    empty.add_column(Text(_name_heading(table)), no_wrap=True, vertical="bottom", min_width=_name_width(table))
    for at in columns:
        empty.add_column(Text(table.headings[at].text), no_wrap=True, min_width=needed[at] - GAP)
    return empty


def _without_columns(has_headings: bool = True) -> "RichTable":
    """Return a table with the look of all tables."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table as RichTable

    return RichTable(
        box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False, show_header=has_headings
    )


def _text(cell: Cell) -> "Text":
    from rich.text import Text

    return Text(cell.text, style="bold red" if cell.alarm else "bold" if cell.strong else "")


def _style(row: TableRow) -> str:
    if row.is_difference:
        return "bold italic" if row.is_mean else "italic"
    return "bold" if row.is_mean else ""


def _lists(table: Content) -> "Iterator[RenderableType]":
    """Yield a line per value, for consoles on which not even one column fits beside the names."""
    from rich.text import Text

    for section, name, row in zip(_sections(table), _names(table), table.rows, strict=True):
        before = f"{section}: " if section else ""
        yield Text(f"{before}{_name_heading(table)} {name}", style=_style(row) or "underline")
        for heading, cell in zip(table.headings[table.names :], row.cells[table.names :], strict=True):
            if cell.text:
                yield Text(" ".join(f"{heading.text}:".split()), style="dim")
                yield Text(f"  {cell.text}", style=_text(cell).style, overflow="fold")
