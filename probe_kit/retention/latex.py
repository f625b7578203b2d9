"""The retention table in LaTeX: booktabs rules, and five heat colours for retention."""

from collections.abc import Sequence
from itertools import groupby

from probe_kit.retention.cells import (
    ABOVE_CHANCE,
    CONTROL_COLUMNS,
    DIFFERENCE_COLUMNS,
    controlled,
    debiased_value,
    difference_title,
    model_name,
    percent,
    place,
    probed,
    retention_value,
    title,
)
from probe_kit.retention.differences import Difference
from probe_kit.retention.heat import HEAT
from probe_kit.retention.rows import MEAN, RetentionRow

_SPECIAL = {character: f"\\{character}" for character in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "Δ": r"$\Delta$",
    "–": "--",
    "−": "$-$",
}


def latex(rows: Sequence[RetentionRow], differences: Sequence[Difference] = (), notes: Sequence[str] = ()) -> str:
    """Complete `table` environments: retention, then controls and differences between groups where there are any.

    notes: sentences for the author, as comments.
    Needs the packages booktabs and xcolor with its option `table`.
    """
    parts = [_retention_table(rows)]
    if controlled(rows):
        names = ["Model", *(name for name, _ in CONTROL_COLUMNS)]
        cells = [[model_name(row), *(cell(row) for _, cell in CONTROL_COLUMNS)] for row in probed(rows)]
        parts.append(_plain_table(title("Controls", rows), names, cells))
    for heading, of_pair in groupby(differences, key=difference_title):
        cells = [[row.category, *(cell(row) for _, cell in DIFFERENCE_COLUMNS)] for row in of_pair]
        parts.append(_plain_table(heading, ["category", *(name for name, _ in DIFFERENCE_COLUMNS)], cells))
    return "\n".join([*parts, *(f"% {note}" for note in notes)])


def _plain_table(caption: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(
        [
            r"\begin{table}",
            rf"\caption{{{escape(caption)}}}",
            rf"\begin{{tabular}}{{{'l' * len(columns)}}}",
            r"\toprule",
            " & ".join(map(escape, columns)) + r" \\",
            r"\midrule",
            *(" & ".join(map(_coloured, cells)) + r" \\" for cells in rows),
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def _coloured(cell: str) -> str:
    return rf"\textcolor{{red}}{{{escape(cell)}}}" if cell.endswith(ABOVE_CHANCE) else escape(cell)


def _retention_table(rows: Sequence[RetentionRow]) -> str:
    colours = [rf"\definecolor{{{name}}}{{HTML}}{{{rgb}}}" for _, name, rgb in HEAT]
    body: list[str] = []
    for row in rows:
        body += [r"\midrule"] * (row.category == MEAN) + [_line(row)] + [r"\midrule"] * (row.category == MEAN)
    return "\n".join(
        [
            "% needs: \\usepackage{booktabs} \\usepackage[table]{xcolor}",
            *colours,
            r"\begin{table}",
            rf"\caption{{{escape(title('Success rate and retention', rows))}}}",
            r"\begin{tabular}{lllrrrrrrrll}",
            r"\toprule",
            r"Model & View & Category & $n$ & SR & $\Delta$ & Prefix & Layer & Action & Layer"
            r" & Retention & Debiased [95\,\%] \\",
            r"\midrule",
            *body[:-1],
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def escape(text: str) -> str:
    """`text` with LaTeX's special characters made harmless."""
    return "".join(_SPECIAL.get(character, character) for character in text)


def _line(row: RetentionRow) -> str:
    cells = [
        model_name(row),
        row.view or "–",
        row.category,
        str(row.n_episodes),
        percent(row.sr),
        percent(row.delta),
        percent(row.prefix_accuracy),
        place(row.prefix_layer),
        percent(row.action_accuracy),
        place(row.action_layer, row.action_iteration),
        retention_value(row),
        debiased_value(row),
    ]
    escaped = [escape(cell) for cell in cells]
    if row.retention_defined and row.retention is not None:
        escaped[10] = rf"\cellcolor{{{heat_colour(row.retention)}}}{escaped[10]}"
    return " & ".join(escaped) + r" \\"


def heat_colour(value: float) -> str:
    """Name of the colour of a retention value."""
    return next(name for bound, name, _ in HEAT if value < bound)
