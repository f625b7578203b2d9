"""Whose a row of a table is: model, view, call and category, for formats that write them in columns."""

from probe_kit.retention.columns.lines import TableRow
from probe_kit.retention.columns.tables import Table
from probe_kit.retention.columns.text import difference_name, model_name, rule_name
from probe_kit.retention.rows.row import RetentionRow


def row_headings(table: Table) -> tuple[str, ...]:
    """Headings of the columns that name a row; of rows of probes their view and call too."""
    return ("model", "view", "call", "category") if table.by_view else ("model", "category")


def named_cells(table: Table, row: TableRow) -> tuple[str, ...]:
    """What stands under `row_headings`."""
    name = model_name(row) if isinstance(row, RetentionRow) else difference_name(row)
    call = row.run.call if isinstance(row, RetentionRow) else row.call
    return (name, *([row.view or "–", "–" if call is None else str(call)] if table.by_view else ()), row.category)


def titled(table: Table) -> str:
    """The title with the outcome rule, the suites, and whether weights are random or a model did not act."""
    rows = table.run_rows
    what = f"{table.title} by {rule_name(rows)}" if table.title == "Success rate" else table.title
    marked = "; random weights" if any(row.run.random_weights for row in rows) else ""
    marked += "; capture only: no success rate" if any(row.run.capture_only for row in rows) else ""
    return f"{what} ({', '.join(dict.fromkeys(row.run.suite for row in rows))}{marked})"
