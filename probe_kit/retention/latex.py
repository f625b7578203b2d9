"""The retention table in LaTeX: booktabs rules, and five heat colours for retention."""

from collections.abc import Callable, Sequence
from itertools import groupby

from probe_kit.retention.cells import (
    ABOVE_CHANCE,
    CONTROL_COLUMNS,
    DIFFERENCE_COLUMNS,
    FOLLOWED_COLUMNS,
    FURTHER_RETENTION,
    NOT_ACTED,
    action_place,
    beats,
    call_value,
    controlled,
    difference_title,
    first_iteration,
    followed,
    margin_value,
    model_name,
    paper_margin,
    percent,
    prefix_place,
    probed,
    retention_value,
    rule_name,
    title,
)
from probe_kit.retention.conditions import rule_sentences
from probe_kit.retention.differences import Difference
from probe_kit.retention.heat import HEAT
from probe_kit.retention.plain_tables import PlainTable, is_asked
from probe_kit.retention.rows import MEAN, RetentionRow

_SPECIAL = {character: f"\\{character}" for character in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "Δ": r"$\Delta$",
    "–": "--",
    "−": "$-$",
}


def latex(
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference] = (),
    notes: Sequence[str] = (),
    further: Sequence[PlainTable] = (),
) -> str:
    """Complete `table` environments: retention, then controls and differences between groups where there are any.

    further: tables behind these. notes: sentences for the author, as comments.
    Needs the packages booktabs and xcolor with its option `table`.
    """
    parts = [_retention_table(rows)]
    if controlled(rows):
        names = ["Model", "view", "call", *(name for name, _ in CONTROL_COLUMNS)]
        cells = [
            [model_name(row), row.view or "–", call_value(row), *(cell(row) for _, cell in CONTROL_COLUMNS)]
            for row in probed(rows)
        ]
        parts.append(_plain_table(title("Controls", rows), names, cells))
    for heading, of_pair in groupby(differences, key=difference_title):
        cells = [[row.category, *(cell(row) for _, cell in DIFFERENCE_COLUMNS)] for row in of_pair]
        parts.append(_plain_table(heading, ["category", *(name for name, _ in DIFFERENCE_COLUMNS)], cells))
    parts += [_plain_table(f"{own.title} ({own.note})", own.columns, own.cells) for own in further]
    return "\n".join([*parts, *(f"% {note}" for note in (*rule_sentences(rows), *notes))])


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
    columns = _columns(rows)
    asked = any(is_asked(row) for row in rows)
    for place, row in enumerate(rows):
        if place and is_asked(rows[place - 1]) and not is_asked(row):
            body += [r"\midrule"]
        body += (
            [r"\midrule"] * (row.category == MEAN) + [_line(row, columns)] + [r"\midrule"] * (row.category == MEAN)
        )
    what = "SR / accuracy and retention" if asked else "Success rate and retention"
    return "\n".join(
        [
            "% needs: \\usepackage{booktabs} \\usepackage[table]{xcolor}",
            *colours,
            r"\begin{table}",
            rf"\caption{{{escape(title(f'{what} ({rule_name(rows)})', rows))}}}",
            rf"\begin{{tabular}}{{{''.join(kind for _, _, kind in columns)}}}",
            r"\toprule",
            " & ".join("SR / acc." if asked and heading == "SR" else heading for heading, _, _ in columns)
            + r" \\",
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


_Columns = list[tuple[str, Callable[[RetentionRow], str], str]]
_COLUMNS: _Columns = [
    ("Model", model_name, "l"),
    ("View", lambda row: row.view or "–", "l"),
    ("Call", call_value, "r"),
    ("Category", lambda row: row.category, "l"),
    ("$n$", lambda row: str(row.n_episodes), "r"),
    ("SR", lambda row: NOT_ACTED if row.sr is None else percent(row.sr), "r"),
    (r"$\Delta$", margin_value, "r"),
    (r"$\Delta$ (paper)", paper_margin, "r"),
    ("Prefix", lambda row: percent(row.prefix_accuracy), "r"),
    ("Layer", prefix_place, "r"),
    ("Action", lambda row: percent(row.action_accuracy), "r"),
    ("Layer", action_place, "r"),
    ("First it.", first_iteration, "r"),
    ("Prefix beats", beats, "l"),
    (r"Retention, bounded [95\,\%]", retention_value, "l"),
    *((escape(heading[:1].upper() + heading[1:]), cell, "l") for heading, cell in FURTHER_RETENTION),
]
"""Heading in LaTeX, content as text, alignment."""


def _columns(rows: Sequence[RetentionRow]) -> _Columns:
    """Behind the SR, what interventions say, if any row was intervened on."""
    if not followed(rows):
        return _COLUMNS
    place = next(number for number, (heading, _, _) in enumerate(_COLUMNS) if heading == "SR") + 1
    more: _Columns = [(escape(heading[:1].upper() + heading[1:]), cell, "l") for heading, cell in FOLLOWED_COLUMNS]
    return [*_COLUMNS[:place], *more, *_COLUMNS[place:]]


def _line(row: RetentionRow, columns: _Columns) -> str:
    cells = [_coloured_retention(cell, row) for _, cell, _ in columns]
    return " & ".join(cells) + r" \\"


def _coloured_retention(cell: Callable[[RetentionRow], str], row: RetentionRow) -> str:
    text = escape(cell(row))
    if cell is not retention_value or not row.retention_defined or row.retention_bounded is None:
        return text
    return rf"\cellcolor{{{heat_colour(row.retention_bounded)}}}{text}"


def heat_colour(value: float) -> str:
    """Name of the colour of a retention value."""
    return next(name for bound, name, _ in HEAT if value < bound)
