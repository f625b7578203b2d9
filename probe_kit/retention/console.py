"""Retention tables on a console: one block per run, narrow enough for 80 columns."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit.retention.cells import (
    ABOVE_CHANCE,
    CONTROL_COLUMNS,
    DIFFERENCE_COLUMNS,
    Column,
    controlled,
    debiased_value,
    difference_title,
    headed_for,
    model_name,
    number,
    once_per_category,
    percent,
    probed,
    success_interval,
)
from probe_kit.retention.differences import Difference
from probe_kit.retention.rows import MEAN, RetentionRow
from probe_kit.retention.success import Regime

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

_REGIMES: dict[str | None, str] = {
    Regime.KNOWLEDGE: "knowledge",
    Regime.NO_RELIABLE_KNOWLEDGE: "not reliable",
    Regime.FAILURE: "failure",
}


def rich_tables(
    rows: Sequence[RetentionRow], differences: Sequence[Difference] = (), notes: Sequence[str] = ()
) -> "Group":
    """Success rates of every run, its retention and controls per view, differences between groups, notes."""
    from rich.console import Group
    from rich.text import Text

    tables: list[Table] = []
    for _, of_run in groupby(rows, key=lambda row: (row.group, row.run)):
        found = list(of_run)
        tables.append(_table("Success rate", once_per_category(found), _SUCCESS_COLUMNS, [_OUTCOME_LEGEND]))
        for view, of_view in groupby(probed(found), key=lambda row: row.view):
            shown = list(of_view)
            reasons = dict.fromkeys(row.retention_note for row in shown if row.retention_note)
            legend = ["@ depth of the best layer/iteration", *reasons]
            tables.append(_table(f"Retention, view {view}", shown, _RETENTION_COLUMNS, legend))
            if controlled(shown):
                tables.append(_table(f"Controls, view {view}", shown, CONTROL_COLUMNS, [_control_legend(shown)]))
    for title, of_pair in groupby(differences, key=difference_title):
        tables.append(_difference_table(title, list(of_pair)))
    return Group(*tables, *(Text(note, style="yellow") for note in notes))


def _whole(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f}"


def _regime(row: RetentionRow) -> str:
    return f"score {number(row.normalised_score, 1)}" if row.category == MEAN else _REGIMES[row.regime]


def _peak(accuracy: float | None, *places: float | None) -> str:
    """Accuracy in percent, then where: depth, and the iteration of a stream that has several."""
    known = [f"{place:.2f}" if isinstance(place, float) else str(place) for place in places if place is not None]
    return percent(accuracy) + (f" @{'/'.join(known)}" if known else "")


def _retention(row: RetentionRow) -> str:
    return number(row.retention) if row.retention_defined else "n/a"


def _outside(row: RetentionRow) -> str:
    """Out of bounds, and in brackets where the cube never moved; both of all episodes."""
    return percent(row.p_oob) + ("" if row.p_never_moved is None else f" ({percent(row.p_never_moved)})")


_OUTCOME_LEGEND = "wrong, oob (out of bounds) and, in brackets, cube never moved: each in % of all episodes"

_SUCCESS_COLUMNS: list[Column] = [
    ("category", lambda row: row.category),
    ("SR % [95 %]", success_interval),
    ("Δ", lambda row: percent(row.delta)),
    ("wrong", lambda row: percent(row.p_wrong)),
    ("oob (never moved)", _outside),
    ("left/right", lambda row: f"{_whole(row.sr_left)} / {_whole(row.sr_right)}"),
    ("regime", _regime),
]

_RETENTION_COLUMNS: list[Column] = [
    ("category", lambda row: row.category),
    ("backbone", lambda row: _peak(row.prefix_accuracy, row.prefix_depth)),
    ("p", lambda row: number(row.prefix_p_fwe, 3)),
    ("expert", lambda row: _peak(row.action_accuracy, row.action_depth, row.action_iteration)),
    ("retention", _retention),
    ("debiased [95 %]", debiased_value),
    ("gap", lambda row: _whole(row.gap)),
]


def _table(what: str, rows: Sequence[RetentionRow], columns: Sequence[Column], notes: Sequence[str]) -> "Table":
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    table.title, table.title_justify = escape(f"{what}: {model_name(rows[0])} on {rows[0].suite}"), "left"
    table.caption, table.caption_justify = escape("; ".join([_sizes(rows), *notes])), "left"
    for name, _ in headed_for(columns, rows):
        table.add_column(escape(name), no_wrap=columns is not CONTROL_COLUMNS, overflow="fold")
    for row in rows:
        table.add_row(*(_coloured(cell(row)) for _, cell in columns), style=_style(row.category))
    return table


def _difference_table(title: str, rows: Sequence[Difference]) -> "Table":
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), title=title, title_justify="left")
    for name, _ in DIFFERENCE_COLUMNS:
        table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(*(_coloured(cell(row)) for _, cell in DIFFERENCE_COLUMNS), style=_style(row.category))
    return table


def _coloured(cell: str) -> "Text":
    from rich.text import Text

    return Text(cell, style="bold red" if cell.endswith(ABOVE_CHANCE) else "")


def _style(category: str) -> str | None:
    return "bold" if category == MEAN else None


def _control_legend(rows: Sequence[RetentionRow]) -> str:
    twin = f"; twin {rows[0].twin}" if rows[0].twin else ""
    return f"held-out accuracy % without the model; selectivity of backbone / {rows[0].action_stream}{twin}"


def _sizes(rows: Sequence[RetentionRow]) -> str:
    """What is the same, or nearly so, in all rows."""
    single = [row for row in rows if row.category != MEAN]
    parts = [
        f"run {Path(rows[0].run).name}",
        f"per category {_span([row.n_episodes for row in single])} episodes",
        f"{_span([row.n_items for row in single])} items",
    ]
    if groups := [row.n_groups for row in single if row.n_groups is not None]:
        parts.append(f"{_span(groups)} groups")
    flags = [percent(row.p_flagged) for row in single if row.p_flagged is not None]
    if flags:
        parts.append(f"no action in {' / '.join(dict.fromkeys(flags))} % of steps (flagged)")
    if chances := {percent(row.chance) for row in single if row.chance is not None}:
        parts.append(f"chance {' or '.join(sorted(chances))} %")
    return ", ".join(parts)


def _span(numbers: Sequence[int]) -> str:
    low, high = min(numbers), max(numbers)
    return str(low) if low == high else f"{low}–{high}"
