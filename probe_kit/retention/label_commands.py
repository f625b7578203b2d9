"""`probe-kit retention --target COLUMN`: retention of a label of one's own."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit._terminal.console import out, print_json_text, print_text

if TYPE_CHECKING:
    from probe_kit.retention.choices import TableFormat
    from probe_kit.retention.estimators.retention import Iterations
    from probe_kit.train.data.run_reader import RunReader


def show_label_retention(
    runs: "Sequence[RunReader]",
    target: str,
    views: Sequence[str] | None,
    iterations: "Iterations",
    keys: Sequence[str | None],
    style: "TableFormat",
) -> None:
    """Print the retention table of a label."""
    from probe_kit.retention.labels.table import label_retention_table

    table = label_retention_table(runs, target, views, iterations=iterations, keys=keys)
    if style == "table":
        out.print(table.to_rich())
    else:
        show = print_json_text if style == "json" else print_text
        show(getattr(table, f"to_{style}")())
