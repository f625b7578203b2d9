"""`probe-kit view`."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit._terminal.console import err, out, say
from probe_kit._terminal.options import NAMED, Names, Partial
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    from probe_kit.runs import Run

RUNS_BY_NAME: "list[Callable[[str], list[Run] | None]]" = []
"""Functions that find several runs by one name, or return None for an unknown one.

The command line adds studies.
"""


def view(
    runs: Annotated[
        list[str],
        typer.Argument(
            help="Run folders or URLs, folders that hold runs, or study files, whose runs are opened.",
            metavar="RUN…",
        ),
    ],
    export: Annotated[
        Path | None,
        typer.Option(
            "--export", metavar="FOLDER", help="Write the pages to a folder that opens without a server, and stop."
        ),
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
    probes_of: Annotated[
        str | None,
        typer.Option(
            "--probes-of",
            metavar="RUN",
            help="For runs without probes, such as unfinished ones: use the probes of this run, of the "
            "same model.",
        ),
    ] = None,
    partial: Partial = False,
) -> None:
    """Look at runs in a browser: overview, layer × iteration maps, single episodes, two runs compared.

    A server on this machine shows unfinished runs too and follows their new episodes. Ctrl-C ends it.
    """
    from probe_kit.runs import open_run

    lender = None if probes_of is None else open_run(probes_of, allow_partial=True)
    if export is None:
        if categories or without_frames:
            raise UsageError("--only and --without-frames are of an export; give --export FOLDER too")
        _serve(_open_runs(runs, True), lender, port, no_browser)
        return
    from probe_kit.view import write_viewer

    opened = _open_runs(runs, partial)
    with err.status("exporting"):
        page = write_viewer(opened, export, frames=not without_frames, categories=categories, probes_of=lender)
    out.print(str(page), soft_wrap=True)


def _open_runs(names: list[str], partial: bool) -> "list[Run]":
    """Return the runs of these names: a run, the runs below a folder, or those that `RUNS_BY_NAME` knows."""
    from probe_kit.runs import open_run
    from probe_kit.runs.run_folders import find_runs, is_run

    opened: list[Run] = []
    for name in names:
        if Path(name).is_dir() and not is_run(Path(name)):
            opened += [open_run(path, allow_partial=partial) for path in find_runs(Path(name))]
            continue
        several = next((runs for find in RUNS_BY_NAME if (runs := find(name)) is not None), None)
        opened += [open_run(name, allow_partial=partial)] if several is None else several
    return opened


def _serve(runs: "list[Run]", lender: "Run | None", port: int, no_browser: bool) -> None:
    import webbrowser

    from probe_kit.view.catalogue import Catalogue
    from probe_kit.view.server import ViewerServer

    server = ViewerServer(Catalogue(runs, lender), port)
    out.print(server.address, soft_wrap=True)
    say("Ctrl-C ends the viewer.")
    with server.private_file() as file:
        if not no_browser:
            webbrowser.open(file.as_uri())
        with suppress(KeyboardInterrupt):
            server.run()
