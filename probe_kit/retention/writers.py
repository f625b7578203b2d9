"""Retention tables for people: on a console and in Markdown."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from probe_kit.retention.rows import MEAN, RetentionRow

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

Column = tuple[str, Callable[[RetentionRow], str]]


def percent(value: float | None) -> str:
    """A share as a percentage with one decimal; a dash for None."""
    return "–" if value is None else f"{100 * value:.1f}"


def number(value: float | None, digits: int = 2) -> str:
    """A number with two decimals; a dash for None."""
    return "–" if value is None else f"{value:.{digits}f}"


def model_name(row: RetentionRow) -> str:
    """The model, marked if its weights are random."""
    return f"{row.model} (random weights)" if row.random_weights else row.model


def success_interval(row: RetentionRow) -> str:
    """SR in percent with its interval."""
    interval = "" if row.sr_ci is None else f" [{percent(row.sr_ci[0])}, {percent(row.sr_ci[1])}]"
    return percent(row.sr) + interval


def retention_value(row: RetentionRow) -> str:
    """Plain retention, or why there is none."""
    if not row.retention_defined or row.retention is None:
        return row.retention_note
    return " ".join(filter(None, [number(row.retention), row.retention_note and f"({row.retention_note})"]))


def debiased_value(row: RetentionRow) -> str:
    """Debiased retention with its interval; a dash where retention is not defined."""
    if not row.retention_defined:
        return "–"
    if row.retention_ci is None:
        return number(row.retention_debiased)
    low, high = row.retention_ci
    interval = "[unbounded]" if low is None or high is None else f"[{low:.2f}, {high:.2f}]"
    return f"{number(row.retention_debiased)} {interval}"


def peak(depth: float | None, iteration: int | None = None) -> str:
    """Depth of the best layer, with the iteration where the stream has several."""
    return number(depth) if iteration is None else f"{number(depth)} @{iteration}"


SUCCESS_COLUMNS: list[Column] = [
    ("model", model_name),
    ("category", lambda row: row.category),
    ("SR % [95 %]", success_interval),
    ("Δ %", lambda row: percent(row.delta)),
    ("wrong %", lambda row: percent(row.p_wrong)),
    ("outside %", lambda row: percent(row.p_oob)),
    ("original / swapped %", lambda row: f"{percent(row.sr_original)} / {percent(row.sr_swapped)}"),
    ("left / right %", lambda row: f"{percent(row.sr_left)} / {percent(row.sr_right)}"),
    ("regime", lambda row: row.regime or f"normalised score {number(row.normalised_score, 1)}"),
    ("n (items)", lambda row: f"{row.n_episodes} ({row.n_items})"),
]

RETENTION_COLUMNS: list[Column] = [
    ("model", model_name),
    ("view", lambda row: row.view or "–"),
    ("category", lambda row: row.category),
    ("prefix %", lambda row: percent(row.prefix_accuracy)),
    ("at depth", lambda row: peak(row.prefix_depth)),
    ("p", lambda row: number(row.prefix_p_fwe, 3)),
    ("action %", lambda row: percent(row.action_accuracy)),
    ("at depth @step", lambda row: peak(row.action_depth, row.action_iteration)),
    ("retention", retention_value),
    ("debiased [95 %]", debiased_value),
    ("gap %", lambda row: percent(row.gap)),
    ("chance %", lambda row: percent(row.chance)),
    ("groups", lambda row: "–" if row.n_groups is None else str(row.n_groups)),
]


def once_per_category(rows: Sequence[RetentionRow]) -> list[RetentionRow]:
    """Success rates do not depend on the view: the first row of each run and category."""
    return list({(row.run, row.category): row for row in reversed(rows)}.values())[::-1]


def title(what: str, rows: Sequence[RetentionRow]) -> str:
    """Title of a table: what it shows, on which suites, and whether any weights are random."""
    marked = "; random weights" if any(row.random_weights for row in rows) else ""
    return f"{what} ({', '.join(dict.fromkeys(row.suite for row in rows))}{marked})"


def probed(rows: Sequence[RetentionRow]) -> list[RetentionRow]:
    """The rows that have probes."""
    return [row for row in rows if row.view is not None]


def markdown(rows: Sequence[RetentionRow]) -> str:
    """Success rates and, where there are probes, retention."""
    parts = [_markdown_table("Success rate", once_per_category(rows), SUCCESS_COLUMNS)]
    if probed(rows):
        parts.append(_markdown_table("Retention", probed(rows), RETENTION_COLUMNS))
    return "\n".join(parts)


def rich_tables(rows: Sequence[RetentionRow]) -> "Group":
    """Success rates and, where there are probes, retention."""
    from rich.console import Group

    tables = [_rich_table("Success rate", once_per_category(rows), SUCCESS_COLUMNS)]
    if probed(rows):
        tables.append(_rich_table("Retention", probed(rows), RETENTION_COLUMNS))
    return Group(*tables)


def _markdown_table(what: str, rows: Sequence[RetentionRow], columns: Sequence[Column]) -> str:
    lines = [
        f"**{title(what, rows)}**",
        "",
        _markdown_line([heading for heading, _ in columns]),
        _markdown_line(["---"] * len(columns)),
        *(_markdown_line([cell(row).replace("|", r"\|") for _, cell in columns]) for row in rows),
        "",
    ]
    return "\n".join(lines)


def _markdown_line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _rich_table(what: str, rows: Sequence[RetentionRow], columns: Sequence[Column]) -> "Table":
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(title(what, rows)), title_justify="left")
    for heading, _ in columns:
        table.add_column(escape(heading))
    for row in rows:
        last = row.category == MEAN
        table.add_row(
            *(escape(cell(row)) for _, cell in columns), style="bold" if last else None, end_section=last
        )
    return table
