"""How single values of a retention row read in a table for people."""

from collections.abc import Callable, Sequence

from probe_kit.retention.rows import RetentionRow

Column = tuple[str, Callable[[RetentionRow], str]]
"""Heading, and what a row shows under it."""


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
