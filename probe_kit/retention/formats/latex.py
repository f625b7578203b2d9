"""The retention tables in LaTeX: booktabs rules, five heat colours, and no tabular wider than its line."""

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise

from probe_kit.retention.choices import Section
from probe_kit.retention.columns.columns import Column, ColumnGroup
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
    details: Collection[Section] = (),
) -> str:
    """Return complete `table` environments: the summary, then the tables of some sections, then `further` ones.

    notes: sentences for the author, as comments. unpaired: why runs have no differences, comments too, and a part
    of the caption of success rates. Needs the packages booktabs and graphicx, with details also xcolor with its
    option `table`.
    """
    chosen = [own for table in tables_of(rows, differences, unpaired) if (own := table.only(details)) is not None]
    needs = r"% needs: \usepackage{booktabs} \usepackage{graphicx}" + r" \usepackage[table]{xcolor}" * bool(chosen)
    colours = [rf"\definecolor{{{name}}}{{HTML}}{{{rgb}}}" for _, name, rgb in HEAT] if chosen else []
    texts = [
        latex_table(summary_table(summarise_runs(rows), differences)),
        *(_table(table.without_details()) for table in chosen),
        *map(latex_table, further),
    ]
    return "\n".join([needs, *colours, *_with_own_labels(texts), *(f"% {note}" for note in (*unpaired, *notes))])


def _with_own_labels(texts: Sequence[str]) -> list[str]:
    """Return the tables, a label that comes again with a number behind it."""
    seen: dict[str, int] = {}
    numbered = []
    for text in texts:
        (label,) = re.findall(r"\\label\{(.*)\}", text)
        seen[label] = seen.get(label, 0) + 1
        again = f"-{seen[label]}" if seen[label] > 1 else ""
        numbered.append(text.replace(rf"\label{{{label}}}", rf"\label{{{label}{again}}}"))
    return numbered


def _table(table: Table) -> str:
    """A tabular per group of columns below each other, each with the names of its rows."""
    tabulars = [_tabular_of_part(table, part) for part in table.parts]
    return _in_table(" ".join([f"{titled(table)}.", *table.captions]), table.title, tabulars)


def _tabular_of_part(table: Table, part: ColumnGroup) -> list[str]:
    names = row_headings(table)
    columns = (*names, *(column.heading for column in part.columns))
    lines: list[str] = []
    for before, row in pairwise([None, *table.rows]):
        assert row is not None
        if before is not None and (before.category == MEAN) != (row.category == MEAN):
            lines.append(r"\midrule")
        cells = map(escape, named_cells(table, row))
        lines.append(_line([*cells, *(_cell(column, row) for column in part.columns)]))
    texts = [[cell_text(column, row) for row in table.rows] for column in part.columns]
    return _tabular(columns, lines, "l" * len(names) + "".join(map(_alignment, texts)))


def latex_table(table: TextTable) -> str:
    """A table of text as a `table` environment; needs the packages booktabs and graphicx.

    Its heads span their columns. A table of more than MOST_COLUMNS is divided between heads.
    """
    tabulars = [_tabular_of(part) for part in _parts(table)]
    return _in_table(f"{table.title} ({table.note})", table.title.partition(":")[0], tabulars)


def _tabular_of(table: TextTable) -> list[str]:
    lines = [_line(map(_marked, cells)) for cells in table.cells]
    names = "l" * min(table.names, len(table.columns))
    numbers = "".join(map(_alignment, [*zip(*table.cells, strict=True)][len(names) :])) if table.cells else ""
    alignment = f"{names}{numbers}".ljust(len(table.columns), "l")
    return _tabular(table.columns, lines, alignment, _heads(table.heads))


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


def _in_table(caption: str, title: str, tabulars: Sequence[Sequence[str]]) -> str:
    body = [line for at, tabular in enumerate(tabulars) for line in ([r"\par\medskip"] if at else []) + [*tabular]]
    label = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-") or "table"
    named = [rf"\caption{{{escape(caption)}}}", rf"\label{{tab:{label}}}"]
    return "\n".join([r"\begin{table}", r"\centering", *named, *body, r"\end{table}", ""])


_NUMBER = re.compile(r"[-+−]?\d|< \d|n/a|–|$")
"""The beginning of a cell of numbers."""
_FITTED = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"
"""Before a tabular: one that is wider than its line becomes as wide as it."""


def _alignment(cells: Iterable[str]) -> str:
    """Return `r` for a column of numbers, else `l`."""
    texts = list(cells)
    return "r" if any(texts) and all(_NUMBER.match(text) for text in texts) else "l"


def _tabular(columns: Sequence[str], lines: Sequence[str], alignment: str, heads: Sequence[str] = ()) -> list[str]:
    return [
        _FITTED,
        rf"\begin{{tabular}}{{{alignment}}}",
        r"\toprule",
        *heads,
        _line(map(_heading, columns)),
        r"\midrule",
        *lines,
        r"\bottomrule",
        r"\end{tabular}}",
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
