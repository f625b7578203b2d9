"""`probe-kit run` and `probe-kit export`: look after runs."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from probe_kit._terminal.console import err, out, print_json

app = typer.Typer(help="Look after runs.", no_args_is_help=True)
DAMAGED = 1


@app.command("verify")
def verify(
    run: Annotated[str, typer.Argument(help="Run folder or URL.")],
    deep: Annotated[bool, typer.Option("--deep", help="Read every byte.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
) -> None:
    """Compare a run with what it says of itself; exit 1 if anything is missing or changed."""
    from probe_kit.extract import verify_run

    found = verify_run(run, deep)
    if as_json:
        print_json({**asdict(found), "ok": found.ok, "finished": found.finished})
    else:
        checked = "every byte" if deep else "structure and sizes"
        sealed = "sealed" if found.sealed else "not sealed"
        failed = f", {found.failed} failed" if found.failed else ""
        out.print(f"{found.committed} of {found.planned} episodes{failed}, {sealed}; {checked} checked")
        if found.ok and not found.finished:
            out.print(
                "whole, but not finished: if it was finished before, this is an older state of it. The same "
                "`probe-kit extract` continues it",
                soft_wrap=True,
            )
        for stray in found.strays:
            out.print(f"belongs to no part of the run: {stray}", highlight=False, markup=False, soft_wrap=True)
        for problem in found.problems:
            out.print(f"damaged: {problem}", soft_wrap=True)
    if not found.ok:
        raise typer.Exit(DAMAGED)


@app.command("seal")
def seal_run(run: Annotated[str, typer.Argument(help="Run folder or URL.")]) -> None:
    """Build the columns that make probing fast; `extract` does it by itself at the end."""
    from probe_kit.extract import seal

    out.print("sealed" if seal(run) else "nothing to do")


@app.command("label")
def label(
    run: Annotated[str, typer.Argument(help="Run folder or URL.")],
    text: Annotated[str, typer.Argument(help="What tables and figures call the run from now on.")],
) -> None:
    """Give a run another label; its numbers, hashes and probes stay as they are."""
    from probe_kit.extract import label_run

    label_run(run, text)
    out.print(f"{run}: {text}", markup=False, highlight=False, soft_wrap=True)


def export(
    run: Annotated[str, typer.Argument(help="Run folder or URL.")],
    style: Annotated[str, typer.Option("--format", help="h5, safetensors or parquet.")],
    out_file: Annotated[
        Path | None, typer.Option("--out", help="File to write; default <run>.<format> beside the run.")
    ] = None,
    partial: Annotated[bool, typer.Option("--partial", help="Accept a run that is not finished.")] = False,
) -> None:
    """Write a run as one ordinary file, with its sha256 beside it."""
    from probe_kit.extract import export_run
    from probe_kit.extract.store.export import check_format
    from probe_kit.extract.store.locations.locate import locate

    check_format(style)
    location = locate(run)
    target = out_file or location.beside(f"{location.name}.{style}")
    with err.status("exporting"):
        out.print(str(export_run(location, style, target, partial)), soft_wrap=True)
