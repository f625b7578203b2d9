"""`probe-kit view`."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit._terminal.console import err, out, say
from probe_kit._terminal.options import NAMED, Names, Partial
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from probe_kit.extract import Run


def view(
    runs: Annotated[list[str], typer.Argument(help="Run folders or URLs.", metavar="RUN…")],
    export: Annotated[
        Path | None,
        typer.Option("--export", metavar="FOLDER", help="Write a folder that opens without a server, and stop."),
    ] = None,
    categories: Annotated[
        Names | None, typer.Option("--only", **NAMED, help="Categories to export, comma-separated. Default: all.")
    ] = None,
    without_frames: Annotated[
        bool, typer.Option("--without-frames", help="Export no pictures of the episodes.")
    ] = False,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port of the server. 0: any free one.")
    ] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address and open no browser.")
    ] = False,
    partial: Partial = False,
) -> None:
    """Look at runs in a browser: overview, layer × iteration maps, single episodes, two runs compared.

    A server on this machine shows unfinished runs too and follows their new episodes. Ctrl-C ends it.
    """
    from probe_kit.extract import open_run

    if export is None:
        if categories or without_frames:
            raise UsageError("--only and --without-frames are of an export; give --export FOLDER too")
        _serve([open_run(run, allow_partial=True) for run in runs], port, no_browser)
        return
    from probe_kit.view import write_viewer

    opened = [open_run(run, allow_partial=partial) for run in runs]
    with err.status("exporting"):
        page = write_viewer(opened, export, frames=not without_frames, categories=categories)
    out.print(str(page), soft_wrap=True)


def _serve(runs: "list[Run]", port: int, no_browser: bool) -> None:
    import webbrowser

    from probe_kit.view.catalogue import Catalogue
    from probe_kit.view.server import ViewerServer

    server = ViewerServer(Catalogue(runs), port)
    out.print(server.address, soft_wrap=True)
    say("Ctrl-C ends the viewer.")
    if not no_browser:
        webbrowser.open(server.address)
    with suppress(KeyboardInterrupt):
        server.run()
