"""The retention table in LaTeX: booktabs rules, and five heat colours for retention."""

from collections.abc import Callable, Sequence

from probe_kit.retention.columns.conditions import rule_sentences
from probe_kit.retention.columns.lines import TableRow, cell_of, compared, difference_legend
from probe_kit.retention.columns.text import (
    ABOVE_CHANCE,
    CONTROL_COLUMNS,
    DIFFERENCE_TEST,
    FOLLOWED_COLUMNS,
    FURTHER_RETENTION,
    action_place,
    action_share,
    backbone_place,
    backbone_share,
    beats,
    call_value,
    category_name,
    controlled,
    first_iteration,
    followed,
    margin_value,
    model_name,
    paper_margin,
    probed,
    retention_value,
    rule_name,
    success_value,
    title,
    view_name,
)
from probe_kit.retention.columns.text_table import TextTable, is_asked
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.formats.heat import HEAT
from probe_kit.retention.rows.row import MEAN, RetentionRow

_SPECIAL = {character: f"\\{character}" for character in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "Δ": r"$\Delta$",
    "–": "--",
    "−": "$-$",
    "<": "$<$",
    ">": "$>$",
    "·": r"$\cdot$",
}


def latex(
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference] = (),
    notes: Sequence[str] = (),
    further: Sequence[TextTable] = (),
    unpaired: Sequence[str] = (),
) -> str:
    """Complete `table` environments: retention with differences between runs, then controls where there are any.

    further: tables behind these. notes: sentences for the author, as comments. unpaired: why runs have no
    differences, a part of the caption.
    Needs the packages booktabs and xcolor with its option `table`.
    """
    parts = [_retention_table(rows, differences, unpaired)]
    if controlled(rows):
        columns = [("Model", model_name), ("view", view_name), ("call", call_value), *CONTROL_COLUMNS]
        cells = [[cell_of(cell, line) for _, cell in columns] for line in compared(probed(rows))]
        parts.append(_plain_table(title("Controls", rows), [name for name, _ in columns], cells))
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


def _retention_table(
    rows: Sequence[RetentionRow], differences: Sequence[Difference], unpaired: Sequence[str]
) -> str:
    colours = [rf"\definecolor{{{name}}}{{HTML}}{{{rgb}}}" for _, name, rgb in HEAT]
    asked = any(is_asked(row) for row in rows)
    what = "SR / accuracy and retention" if asked else "Success rate and retention"
    caption = title(f"{what} ({rule_name(rows)})", rows)
    said = [sentence for sentence in (difference_legend(differences), *unpaired) if sentence]
    columns = _columns(rows, differences)
    return "\n".join(
        [
            "% needs: \\usepackage{booktabs} \\usepackage[table]{xcolor}",
            *colours,
            r"\begin{table}",
            rf"\caption{{{escape('. '.join([caption, *said]))}}}",
            rf"\begin{{tabular}}{{{''.join(kind for _, _, kind in columns)}}}",
            r"\toprule",
            " & ".join("SR / acc." if asked and heading == "SR" else heading for heading, _, _ in columns)
            + r" \\",
            r"\midrule",
            *_body(rows, differences, columns),
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def _body(
    rows: Sequence[RetentionRow], differences: Sequence[Difference], columns: "Sequence[_Column]"
) -> list[str]:
    """Lines with a rule around means and between VLM runs and policy runs."""
    body: list[str] = []
    for kind in dict.fromkeys(row.kind for row in rows):
        of_kind = [row for row in rows if row.kind == kind]
        body += [r"\midrule"] * bool(body and body[-1] != r"\midrule")
        lines = compared(of_kind, differences)
        for before, line in zip([None, *lines], lines, strict=False):
            new = before is None or (before.category == MEAN) != (line.category == MEAN)
            body += [r"\midrule"] * bool(body and new and body[-1] != r"\midrule") + [_line(line, columns)]
    return body


def escape(text: str) -> str:
    """`text` with LaTeX's special characters made harmless."""
    return "".join(_SPECIAL.get(character, character) for character in text)


def _heading(text: str) -> str:
    """With a capital, and percent close to its number."""
    return escape(text[:1].upper() + text[1:]).replace(r" \%", r"\,\%")


_Column = tuple[str, Callable[[RetentionRow], str], str]
_COLUMNS: list[_Column] = [
    ("Model", model_name, "l"),
    ("View", view_name, "l"),
    ("Call", call_value, "r"),
    ("Category", category_name, "l"),
    ("$n$", lambda row: str(row.n_episodes), "r"),
    ("SR", success_value, "r"),
    ("$p$ (Holm)", DIFFERENCE_TEST[1], "r"),
    (r"$\Delta$", margin_value, "r"),
    (r"$\Delta$ (paper)", paper_margin, "r"),
    ("Prefix", backbone_share, "r"),
    ("Layer", backbone_place, "r"),
    ("Action", action_share, "r"),
    ("Layer", action_place, "r"),
    ("First it.", first_iteration, "r"),
    ("Prefix beats", beats, "l"),
    (r"Retention, bounded [95\,\%]", retention_value, "l"),
    *((_heading(heading), cell, "l") for heading, cell in FURTHER_RETENTION),
]
"""Heading in LaTeX, content as text, alignment."""


def _columns(rows: Sequence[RetentionRow], differences: Sequence[Difference]) -> list[_Column]:
    """Behind the SR, tests of differences and what interventions say, as far as there are any."""
    more = [(_heading(heading), cell, "l") for heading, cell in FOLLOWED_COLUMNS]
    place = next(number for number, column in enumerate(_COLUMNS) if column[1] is DIFFERENCE_TEST[1]) + 1
    columns = [*_COLUMNS[:place], *(more if followed(rows) else []), *_COLUMNS[place:]]
    return [column for column in columns if differences or column[1] is not DIFFERENCE_TEST[1]]


def _line(line: TableRow, columns: Sequence[_Column]) -> str:
    return " & ".join(_coloured_retention(cell, line) for _, cell, _ in columns) + r" \\"


def _coloured_retention(cell: Callable[[RetentionRow], str], line: TableRow) -> str:
    text = escape(cell_of(cell, line))
    heated = cell is retention_value and isinstance(line, RetentionRow) and line.retention_defined
    if not heated or line.retention_bounded is None:
        return text
    return rf"\cellcolor{{{heat_colour(line.retention_bounded)}}}{text}"


def heat_colour(value: float) -> str:
    """Name of the colour of a retention value."""
    return next(name for bound, name, _ in HEAT if value < bound)
