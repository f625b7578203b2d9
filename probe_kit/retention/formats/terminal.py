"""Retention tables on a console: one block per table, whole at any width."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable
from probe_kit.retention.behaviour.wordings import WordingPair
from probe_kit.retention.choices import Section
from probe_kit.retention.columns.conditions import wording_tables
from probe_kit.retention.columns.lines import TableRow
from probe_kit.retention.columns.summary import RunSummary, summarise_runs, summary_table
from probe_kit.retention.columns.tables import Table, cell_text, tables_of, views_of
from probe_kit.retention.columns.text import ABOVE_CHANCE, call_words, difference_items, is_vlm, model_name
from probe_kit.retention.columns.text_table import TextTable
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.rows.row import MEAN, RetentionRow

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, Group, RenderableType
    from rich.text import Text

_VALUE = re.compile(r"(?P<value>\S+) (?P<limits>\[.*\])(?P<mark>.*)")
"""A cell of the summary with an interval."""
_Letters = Mapping[tuple[str | None, str], str]
"""By group and run, what it is called in a table of several."""


def rich_tables(
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference] = (),
    notes: Sequence[str] = (),
    wordings: Sequence[WordingPair] = (),
    further: Sequence[TextTable] = (),
    unpaired: Sequence[str] = (),
    details: Collection[Section] = (),
) -> "Group":
    """The tables of some sections, and at last the summary: one table, the notes, and a sentence per category.

    Several runs go by letters in details, under each other, with their differences below them. VLM runs stand
    above a rule. further: tables of the section `answers`. unpaired: why runs have no differences.
    """
    from rich.console import Group
    from rich.rule import Rule
    from rich.text import Text

    called = _letters(rows)
    blocks: list[ResponsiveTable | Rule | Text] = []
    for of_mode in ([row for row in rows if is_vlm(row)], [row for row in rows if not is_vlm(row)]):
        if blocks and of_mode:
            blocks.append(Rule("VLM runs above, policy runs below", style="dim"))
        chosen = [own for table in tables_of(of_mode, differences) if (own := table.only(details)) is not None]
        tables = [part for table in chosen for part in views_of(table)]
        blocks += [_block(table.without_details(), called) for table in tables]
    plain = [*(wording_tables(wordings) if "success" in details else []), *further]
    found = summarise_runs(rows)
    why = unpaired if details or len(found) > 1 else ()
    said = [Text(sentence, style="yellow") for sentence in (*why, *notes)]
    return Group(*blocks, *map(responsive_table, plain), _Summary(found, differences), *said, *_sentences(found))


@dataclass(frozen=True)
class _Summary:
    """The summary's table; where it would not fit, cells have two lines, and else no intervals."""

    found: Sequence[RunSummary]
    differences: Sequence[Difference]

    def __rich_console__(self, _: "Console", options: "ConsoleOptions") -> "Iterator[RenderableType]":
        whole, short = (summary_table(self.found, self.differences, intervals) for intervals in (True, False))
        tables = [responsive_table(table) for table in (whole, _folded(whole), short, _folded(short))]
        yield next((table for table in tables if table.width <= options.max_width), tables[-1])


def _folded(table: TextTable) -> TextTable:
    """The same with intervals below their values, and verdicts broken at commas."""
    verdicts = table.columns.index("verdict") if "verdict" in table.columns else None
    cells = tuple(
        tuple(
            text.replace(", ", ",\n") if at == verdicts else _VALUE.sub(r"\g<value>\g<mark>\n\g<limits>", text)
            for at, text in enumerate(line)
        )
        for line in table.cells
    )
    return replace(table, cells=cells)


def _sentences(found: Sequence[RunSummary]) -> "Iterator[Text]":
    from rich.text import Text

    for run in found:
        if len(found) > 1:
            yield Text(run.title, style="bold")
        for sentence in run.sentences:
            yield Text(sentence)


def _block(table: Table, called: _Letters) -> ResponsiveTable:
    """One run by its name, several by their letters."""
    rows = table.run_rows
    what = f"{table.title}, view {rows[0].view}" if table.by_view else table.title
    runs = {row.key: row for row in reversed(rows)}
    suites = ", ".join(dict.fromkeys(row.run.suite for row in rows))
    if len(called) == 1:
        name, names = "category", [row.category for row in rows]
        title, sizes = f"{what}: {model_name(rows[0])} on {suites}", f"{_folder(rows)}, {_sizes(rows)}"
    else:
        shown = [key for key in called if key in runs]
        title = f"{what}: {', '.join(f'{called[key]} {model_name(runs[key])}' for key in shown)} on {suites}"
        name, names = "category · run", [f"{row.category} {_short(row, rows, called)}" for row in table.rows]
        sizes = _sizes_of({called[key]: [row for row in rows if row.key == key] for key in shown})
    return ResponsiveTable(
        title=title,
        caption=" ".join([f"{sizes}.", *table.captions]),
        name=name,
        names=tuple(names),
        styles=tuple(map(_style, table.rows)),
        parts=tuple(
            Part(
                part.title,
                tuple(column.heading for column in part.columns),
                tuple(tuple(_coloured(cell_text(column, row)) for column in part.columns) for row in table.rows),
            )
            for part in table.parts
        ),
    )


def responsive_table(table: TextTable) -> ResponsiveTable:
    """As wide as the console allows. Columns below one head stay together where they can.

    Where names of the first column repeat, the rows stand in sections of that name.
    """
    firsts = [cells[0] for cells in table.cells]
    sections = table.names > 1 and any(one == other for one, other in pairwise(firsts))
    named = slice(1 if sections else 0, table.names)
    return ResponsiveTable(
        title=table.title,
        caption=table.note,
        name=" · ".join(table.columns[: table.names]),
        names=tuple(" · ".join(cells[named]) for cells in table.cells),
        styles=tuple("bold" if table.means and MEAN in cells[: table.names] else "" for cells in table.cells),
        parts=tuple(_parts(table)),
        sections=tuple(firsts) if sections else (),
    )


def _parts(table: TextTable) -> Iterator[Part]:
    """The columns behind those that name the rows, a part for each head."""
    heads = table.heads or (("", len(table.columns)),)
    of_column = [at for at, (_, count) in enumerate(heads) for _ in range(count)]
    behind = range(table.names, len(table.columns))
    for at, found in groupby(behind, key=lambda column: of_column[column]):
        columns = list(found)
        cells = tuple(tuple(Cell(row[column]) for column in columns) for row in table.cells)
        yield Part(heads[at][0], tuple(table.columns[column] for column in columns), cells)


def _style(row: TableRow) -> str:
    return " ".join(["bold"] * (row.category == MEAN) + ["italic"] * isinstance(row, Difference))


def _coloured(cell: str) -> Cell:
    return Cell(cell, "bold red" if cell.endswith(ABOVE_CHANCE) else "")


# -- names of several runs -----------------------------------------------------------------------------------


def _letters(rows: Sequence[RetentionRow]) -> _Letters:
    runs = dict.fromkeys(row.key for row in rows)
    return {run: _letter(at) for at, run in enumerate(runs)}


def _letter(at: int) -> str:
    """A to Z, then A2 to Z2."""
    round_, place = divmod(at, 26)
    return chr(ord("A") + place) + (str(round_ + 1) if round_ else "")


def _short(row: TableRow, rows: Sequence[RetentionRow], called: _Letters) -> str:
    """A run's letter, or those of two; a group of several runs by its name."""
    if isinstance(row, RetentionRow):
        return called[row.key]
    letters: dict[str, list[str]] = {}
    for one in rows:
        letters.setdefault(model_name(one) if one.group is None else one.group, []).append(called[one.key])
    sides = ["".join(dict.fromkeys(letters[side])) for side in (row.group, row.minus)]
    mark = difference_items(row)
    return " − ".join(sides) + (f", {mark}" if mark else "")


# -- sizes ---------------------------------------------------------------------------------------------------


def _sizes_of(runs: Mapping[str, Sequence[RetentionRow]]) -> str:
    """Of several runs by their letters; what is the same of all is said once."""
    found = {letter: _sizes(rows) for letter, rows in runs.items()}
    if len(set(found.values())) == 1:
        return "; ".join([*(f"{letter}: {_folder(rows)}" for letter, rows in runs.items()), *set(found.values())])
    return "; ".join(f"{letter}: {_folder(runs[letter])}, {sizes}" for letter, sizes in found.items())


def _folder(rows: Sequence[RetentionRow]) -> str:
    return f"run {Path(rows[0].run.location).name}"


def _sizes(rows: Sequence[RetentionRow]) -> str:
    """What is the same, or nearly so, in all rows."""
    single = [row for row in rows if row.category != MEAN]
    parts = [
        f"per category {_span([row.success.n_episodes for row in single])} episodes",
        f"{_span([row.success.n_items for row in single])} items",
    ]
    if groups := [row.controls.n_groups for row in single if row.controls.n_groups is not None]:
        parts.append(f"{_span(groups)} groups")
    if calls := sorted({row.run.call for row in single if row.run.call is not None}):
        parts.append("; ".join(map(call_words, calls)))
    return ", ".join(parts)


def _span(numbers: Sequence[int]) -> str:
    low, high = min(numbers), max(numbers)
    return str(low) if low == high else f"{low}–{high}"
