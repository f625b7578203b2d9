"""`probe-kit retention --target COLUMN`: retention of labels of one's own."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit._system.counting import counted
from probe_kit._terminal.console import err, out, print_json_text, print_text, say

if TYPE_CHECKING:
    from probe_kit.retention.choices import TableFormat
    from probe_kit.retention.displays.base.report_figure import ReportFigure
    from probe_kit.retention.labels.table import LabelRetentionTable
    from probe_kit.train.data.run_reader import RunReader


def show_label_retention(
    runs: "Sequence[RunReader]",
    table: "LabelRetentionTable",
    style: "TableFormat",
    html: Path | None,
    figures: Path | None,
    details: bool = False,
) -> None:
    """Print the retention table of labels, and write its report and figures where that was asked for."""
    if figures is not None:
        from probe_kit.retention.displays.labels import label_figures

        save_all(label_figures(runs, table), figures, details)
    if html is not None:
        from probe_kit.retention.report import write_label_report

        with err.status("drawing the report"):
            written = write_label_report(runs, html, table)
        say_report(written)
    if style == "table":
        out.print(table.to_rich())
    else:
        print_text_of(table, style)


def print_text_of(table: Any, style: str) -> None:
    """Print a table as JSON, as CSV or in a format of text."""
    if style == "json":
        print_json_text(table.to_json())
    else:
        formats = {"csv": table.to_csv, "markdown": table.to_markdown, "latex": table.to_latex}
        print_text(formats[style]() if style in formats else table.to_text(style))


def save_all(exhibits: "Sequence[ReportFigure]", folder: Path, details: bool = False) -> None:
    """Draw the main figures into a folder, and say where each is and how many are left out.

    details: draw every figure.
    """
    from probe_kit.retention.displays import save_figures

    drawn = [exhibit for exhibit in exhibits if details or not exhibit.is_detail]
    for path in save_figures(drawn, folder):
        say(f"figure: {path}")
    if left_out := len(exhibits) - len(drawn):
        say(f"{counted(left_out, 'further figure')}: add --details all")


def say_report(written: Path) -> None:
    """Say where a report is, and how large."""
    from probe_kit.runs.disk import in_units

    say(f"report: {written} ({in_units(written.stat().st_size)})")
