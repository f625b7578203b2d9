"""The retention tables in LaTeX: booktabs rules, and five heat colours."""

from collections.abc import Iterable, Sequence
from itertools import pairwise

from probe_kit.retention.columns.columns import Column
from probe_kit.retention.columns.lines import TableRow
from probe_kit.retention.columns.row_names import named_cells, row_headings, titled
from probe_kit.retention.columns.summary import summarise_runs, summary_table
from probe_kit.retention.columns.tables import Table, cell_text, tables_of
from probe_kit.retention.columns.text import ABOVE_CHANCE
from probe_kit.retention.columns.text_table import TextTable
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.formats.heat import HEAT
from probe_kit.retention.rows.row import MEAN, RetentionRow

_SPECIAL = {character: f"\\{character}" for character in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "Δ": r"$\Delta$",
    "±": r"$\pm$",
    "–": "--",
    "−": "$-$",
    "<": "$<$",
    ">": "$>$",
    "·": r"$\cdot$",
    "✓": r"$^{*}$",
}


def latex(
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference] = (),
    notes: Sequence[str] = (),
    further: Sequence[TextTable] = (),
    unpaired: Sequence[str] = (),
) -> str:
    """Complete `table` environments: success rates with differences between runs, retention, then controls.

    The summary and `further` tables stand behind these. notes: sentences for the author, as comments. unpaired:
    why runs have no differences, a part of the caption. Needs the packages booktabs and xcolor with its option
    `table`.
    """
    colours = [rf"\definecolor{{{name}}}{{HTML}}{{{rgb}}}" for _, name, rgb in HEAT]
    parts = ["% needs: \\usepackage{booktabs} \\usepackage[table]{xcolor}", *colours]
    found = summarise_runs(rows)
    whole = summary_table(found, differences)
    further = [whole, *further]
    parts += [_table(table.without_details()) for table in tables_of(rows, differences, unpaired)]
    parts += map(latex_table, further)
    return "\n".join([*parts, *(f"% {note}" for note in notes)])


def _table(table: Table) -> str:
    columns = (*row_headings(table), *(column.heading for column in table.columns))
    lines: list[str] = []
    for before, row in pairwise([None, *table.rows]):
        assert row is not None
        if before is not None and (before.category == MEAN) != (row.category == MEAN):
            lines.append(r"\midrule")
        names = map(escape, named_cells(table, row))
        lines.append(_line([*names, *(_cell(column, row) for column in table.columns)]))
    return _environment(" ".join([f"{titled(table)}.", *table.captions]), columns, lines)


def latex_table(table: TextTable) -> str:
    """A table of text as a `table` environment; needs the package booktabs."""
    lines = [_line(map(_marked, cells)) for cells in table.cells]
    return _environment(f"{table.title} ({table.note})", table.columns, lines)


def _environment(caption: str, columns: Sequence[str], lines: Sequence[str]) -> str:
    return "\n".join(
        [
            r"\begin{table}",
            rf"\caption{{{escape(caption)}}}",
            rf"\begin{{tabular}}{{{'l' * len(columns)}}}",
            r"\toprule",
            _line(map(_heading, columns)),
            r"\midrule",
            *lines,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def _line(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"


def _cell(column: Column, row: TableRow) -> str:
    text = _marked(cell_text(column, row))
    heat = column.sort_value(row) if column.heat and isinstance(row, RetentionRow) else None
    return text if heat is None else rf"\cellcolor{{{heat_colour(heat)}}}{text}"


def _marked(cell: str) -> str:
    return rf"\textcolor{{red}}{{{escape(cell)}}}" if cell.endswith(ABOVE_CHANCE) else escape(cell)


def _heading(text: str) -> str:
    """Percent close to its number."""
    return escape(text).replace(r" \%", r"\,\%")


def escape(text: str) -> str:
    """`text` with LaTeX's special characters made harmless."""
    return "".join(_SPECIAL.get(character, character) for character in text)


def heat_colour(value: float) -> str:
    """Name of the colour of a share or ratio."""
    return next(name for bound, name, _ in HEAT if value < bound)
