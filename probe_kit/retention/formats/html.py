"""Tables of the report: cells with what they show, what they sort by, and their heat."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from probe_kit.retention.columns.columns import Column
from probe_kit.retention.columns.glossary import TERMS
from probe_kit.retention.columns.lines import TableRow
from probe_kit.retention.columns.summary import HEADING_HELP
from probe_kit.retention.columns.tables import Table, cell_text, tables_of
from probe_kit.retention.columns.text import ABOVE_CHANCE, difference_name, model_name
from probe_kit.retention.columns.text_table import TextTable
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.formats.heat import heat_colour
from probe_kit.retention.rows.row import MEAN, RetentionRow
from probe_kit.retention.text import spell


@dataclass(frozen=True)
class HtmlCell:
    """sort: what the column sorts by, None for last. heat: background, `#RRGGBB`. strong: bold. alarm: red.

    note: shown on pointing at it. below: a second line, of smaller letters: whose row it is. difference: whether
    the row is that of a difference, which stays below those of runs when these are sorted.
    """

    text: str
    sort: float | str | None = None
    heat: str | None = None
    strong: bool = False
    alarm: bool = False
    note: str = ""
    below: str = ""
    difference: bool = False

    @property
    def value(self) -> str:
        """The text without an interval in square brackets."""
        before, _, after = self.text.partition(self.limits) if self.limits else (self.text, "", "")
        return f"{before.rstrip()}{after}"

    @property
    def limits(self) -> str:
        """That interval with its brackets, empty without one: it may go to a line of its own."""
        found = re.search(r"(?<!^)\[[^\]]*\]", self.text)
        return found[0] if found else ""


@dataclass(frozen=True)
class HtmlColumn:
    """word: in the glossary. explanation: its entry there, shown on pointing at the heading; empty without one."""

    name: str
    explanation: str
    numeric: bool
    word: str = ""


@dataclass(frozen=True)
class HtmlTable:
    """body is sorted by a click on a heading; foot, the means, stays. captions: sentences below it.

    subject: see `Table`. details: whether it holds the columns that need room."""

    title: str
    columns: tuple[HtmlColumn, ...]
    body: tuple[tuple[HtmlCell, ...], ...]
    foot: tuple[tuple[HtmlCell, ...], ...] = ()
    captions: tuple[str, ...] = ()
    subject: str = ""
    details: bool = False


def html_tables(
    rows: Sequence[RetentionRow], differences: Sequence[Difference] = (), unpaired: Sequence[str] = ()
) -> list[HtmlTable]:
    """Every table that the rows allow, each followed by its details. unpaired: why runs have no differences."""
    found = []
    for table in tables_of(rows, differences, unpaired):
        found.append(_table(table.without_details()))
        if (details := table.details()) is not None:
            found.append(replace(_table(details), details=True))
    return found


def plain_tables(tables: Sequence[TextTable]) -> list[HtmlTable]:
    """As they are; rows of means stay below when others are sorted."""
    return [
        HtmlTable(
            table.title,
            tuple(
                HtmlColumn(_unbroken(name), HEADING_HELP.get(name, ""), name not in _WORDS, name)
                for name in _full_headings(table)
            ),
            _plain_rows(table, means=False),
            _plain_rows(table, means=True),
            (f"{table.note[:1].upper()}{table.note[1:]}.",) if table.note else (),
        )
        for table in tables
    ]


def _plain_rows(table: TextTable, means: bool) -> tuple[tuple[HtmlCell, ...], ...]:
    """Those of means, or the others."""
    return tuple(
        tuple(HtmlCell(cell, cell) for cell in cells)
        for cells in table.cells
        if (table.means and MEAN in cells[:2]) == means
    )


def _full_headings(table: TextTable) -> list[str]:
    """Columns with the name above them where they lack it, as a page has one line of headings."""
    heads = [head for head, count in table.heads for _ in range(count)] or [""] * len(table.columns)
    return [
        f"{head} {name}" if head and not name.startswith(head) else name
        for head, name in zip(heads, table.columns, strict=True)
    ]


_WORDS = (
    "model", "run", "category", "prompt", "verdict", "label", "metric", "view", "backbone site", "action site",
    "stream", "best site", "exceeds", "system", "systems", "half", "runs", "groups", "blocks", "state",
)  # fmt: skip
"""Columns of plain tables that hold no numbers."""


def _table(table: Table) -> HtmlTable:
    several = len({row.key for row in table.run_rows}) > 1
    body, foot = (
        tuple(
            (*_names(table, row, several), *(_cell(column, row) for column in table.columns))
            for row in table.rows
            if (row.category == MEAN) == is_mean
        )
        for is_mean in (False, True)
    )
    headings = (*_name_headings(table), *(_heading(column, table.run_rows) for column in table.columns))
    return HtmlTable(table.title, headings, body, foot, table.captions, table.subject)


def _name_headings(table: Table) -> list[HtmlColumn]:
    named = [HtmlColumn("category", "Kind of question, and of several runs which one.", False, "category")]
    if table.by_view:
        named.append(HtmlColumn("view", "How the tokens of an episode became one vector.", False, "view"))
        named.append(HtmlColumn("call", TERMS["call"], True, "call"))
    return named


def _names(table: Table, row: TableRow, several: bool) -> list[HtmlCell]:
    """several: whether the category says whose row it is."""
    below = (difference_name(row) if isinstance(row, Difference) else model_name(row)) if several else ""
    is_difference = isinstance(row, Difference)
    sort = spell(row.category) if is_difference else row.category
    cells = [HtmlCell(spell(row.category), sort, below=below, difference=is_difference)]
    if table.by_view:
        call = row.call if isinstance(row, Difference) else row.run.call
        cells.append(HtmlCell(row.view or "–", row.view or "", difference=is_difference))
        cells.append(HtmlCell("–" if call is None else str(call), call, difference=is_difference))
    return cells


def _heading(column: Column, rows: Sequence[RetentionRow]) -> HtmlColumn:
    numeric = column.difference is not None or any(column.text(row)[:1].isdigit() for row in rows)
    return HtmlColumn(_unbroken(column.heading), column.help, numeric, column.heading)


def _unbroken(name: str) -> str:
    """A heading that does not break before a unit."""
    return name.replace(" %", "\u00a0%").replace("± ", "±\u00a0")


def _cell(column: Column, row: TableRow) -> HtmlCell:
    text = cell_text(column, row)
    if isinstance(row, Difference):
        return HtmlCell(text, _leading_number(text), difference=True)
    value = column.sort_value(row)
    return HtmlCell(
        text=text,
        sort=value,
        heat=heat_colour(value) if column.heat and isinstance(value, float) else None,
        strong=column.strong is not None and column.strong(row),
        alarm=text.endswith(ABOVE_CHANCE),
        note=column.note(row) if column.note else "",
    )


def _leading_number(text: str) -> float | None:
    """Differences are sorted among themselves, by the number that they begin with."""
    start, *_ = text.split() or [""]
    try:
        return float(start)
    except ValueError:
        return None
