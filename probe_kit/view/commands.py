"""`probe-kit view`."""

from pathlib import Path
from typing import Annotated

import typer

from probe_kit._terminal.console import err, out
from probe_kit._terminal.options import NAMED, Names, Partial


def view(
    runs: Annotated[list[str], typer.Argument(help="Run folders or URLs.", metavar="RUN…")],
    export: Annotated[
        Path, typer.Option("--export", metavar="FOLDER", help="Write a folder that opens without a server.")
    ],
    categories: Annotated[
        Names | None, typer.Option("--only", **NAMED, help="Categories to export, comma-separated. Default: all.")
    ] = None,
    without_frames: Annotated[
        bool, typer.Option("--without-frames", help="Export no pictures of the episodes.")
    ] = False,
    partial: Partial = False,
) -> None:
    """Look at runs in a browser: overview, layer × iteration maps, single episodes, two runs compared."""
    from probe_kit.extract import open_run
    from probe_kit.view import write_viewer

    opened = [open_run(run, allow_partial=partial) for run in runs]
    with err.status("exporting"):
        page = write_viewer(opened, export, frames=not without_frames, categories=categories)
    out.print(str(page), soft_wrap=True)
