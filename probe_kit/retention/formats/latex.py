"""The retention tables in LaTeX: booktabs rules, and five heat colours."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise

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

_GREEK = {
    "α": "alpha", "β": "beta", "γ": "gamma", "δ": "delta", "ε": "epsilon", "θ": "theta", "λ": "lambda", "μ": "mu",
    "π": "pi", "ρ": "rho", "σ": "sigma", "τ": "tau", "φ": "phi", "ψ": "psi", "ω": "omega", "Δ": "Delta",
}  # fmt: skip
_SPECIAL = {character: f"\\{character}" for character in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "–": "--",
    "−": "$-$",
    "<": "$<$",
    ">": "$>$",
    "|": r"\textbar{}",
    "×": r"$\times$",
    "·": r"$\cdot$",
    "✓": r"$^{*}$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "→": r"$\rightarrow$",
    **{letter: f"$\\{name}$" for letter, name in _GREEK.items()},
}
MOST_COLUMNS = 13
"""Of a tabular; a wider table of text is printed as several below each other, each with the first column."""


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
    """A table of text as a `table` environment; needs the package booktabs.

    Its heads span their columns. A table of more than MOST_COLUMNS is divided between heads.
    """
    return _in_table(f"{table.title} ({table.note})", [_tabular_of(part) for part in _parts(table)])


def _tabular_of(table: TextTable) -> list[str]:
    lines = [_line(map(_marked, cells)) for cells in table.cells]
    return _tabular(table.columns, lines, _heads(table.heads))


def _heads(heads: Sequence[tuple[str, int]]) -> list[str]:
    """A line of names over several columns, and the rules below them."""
    if not heads:
        return []
    ends = list(accumulate(count for _, count in heads))
    rules = [
        rf"\cmidrule(lr){{{end - count + 1}-{end}}}"
        for (name, count), end in zip(heads, ends, strict=True)
        if name
    ]
    return [_line(rf"\multicolumn{{{count}}}{{c}}{{{escape(name)}}}" for name, count in heads), " ".join(rules)]


def _parts(table: TextTable) -> list[TextTable]:
    """Tables of at most MOST_COLUMNS, each with the first column; a head that is wider stays whole."""
    if len(table.columns) <= MOST_COLUMNS:
        return [table]
    first, *others = table.heads or (("", 1) for _ in table.columns)
    parts: list[list[tuple[int, tuple[str, int]]]] = [[]]
    at = first[1]
    for head in others:
        if parts[-1] and first[1] + sum(count for _, (_, count) in parts[-1]) + head[1] > MOST_COLUMNS:
            parts.append([])
        parts[-1].append((at, head))
        at += head[1]
    return [_part(table, first, part) for part in parts]


def _part(table: TextTable, first: tuple[str, int], heads: Sequence[tuple[int, tuple[str, int]]]) -> TextTable:
    start, end = heads[0][0], heads[-1][0] + heads[-1][1][1]
    columns, *cells = ((*row[: first[1]], *row[start:end]) for row in (table.columns, *table.cells))
    shown = (first, *(head for _, head in heads)) if table.heads else ()
    return replace(table, columns=columns, cells=tuple(cells), heads=shown)


def _environment(caption: str, columns: Sequence[str], lines: Sequence[str]) -> str:
    return _in_table(caption, [_tabular(columns, lines)])


def _in_table(caption: str, tabulars: Sequence[Sequence[str]]) -> str:
    body = [line for at, tabular in enumerate(tabulars) for line in ([r"\par\medskip"] if at else []) + [*tabular]]
    return "\n".join([r"\begin{table}", rf"\caption{{{escape(caption)}}}", *body, r"\end{table}", ""])


def _tabular(columns: Sequence[str], lines: Sequence[str], heads: Sequence[str] = ()) -> list[str]:
    return [
        rf"\begin{{tabular}}{{{'l' * len(columns)}}}",
        r"\toprule",
        *heads,
        _line(map(_heading, columns)),
        r"\midrule",
        *lines,
        r"\bottomrule",
        r"\end{tabular}",
    ]


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
