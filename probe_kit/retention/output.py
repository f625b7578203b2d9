"""The output of retention commands beside tables: figures in a folder, and where a report is."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit._system.counting import counted
from probe_kit._terminal.console import say

if TYPE_CHECKING:
    from probe_kit.retention.displays.base.report_figure import ReportFigure


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
