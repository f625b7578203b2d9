"""`probe-kit run`: verify, seal, copy and export runs."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from probe_kit._terminal.console import err, out, print_json, say
from probe_kit._terminal.options import LISTED, AsJson, Names, Partial, RunFolder
from probe_kit.runs.layout import DIRECTION_FILES, ExportFormat, SaeDtype

app = typer.Typer(help="Inspect, verify, copy and export runs.", no_args_is_help=True)
DAMAGED = 1


@app.command("verify")
def verify(
    run: RunFolder,
    deep: Annotated[bool, typer.Option("--deep", help="Read every byte.")] = False,
    build: Annotated[
        bool,
        typer.Option("--seal", help="First build the columns that make probing fast."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Check a run against its stored hashes; exit with 1 if anything is missing or changed."""
    from probe_kit.runs import seal, verify_run

    if build:
        say("sealed" if seal(run) else "nothing to seal")
    audit = verify_run(run, deep)
    if as_json:
        print_json({**asdict(audit), "ok": audit.ok, "finished": audit.finished})
    else:
        checked = "every byte" if deep else "structure and sizes"
        sealed = "sealed" if audit.sealed else "not sealed"
        failed = f", {audit.failed} failed" if audit.failed else ""
        out.print(f"{audit.committed} of {audit.planned} episodes{failed}, {sealed}; {checked} checked")
        if audit.ok and not audit.finished:
            out.print(
                "whole, but not finished: if it was finished before, this is an older state of it. The same "
                "`probe-kit extract` continues it",
                soft_wrap=True,
            )
        if audit.left_out:
            out.print(f"a copy without activations: {', '.join(audit.left_out)}", soft_wrap=True)
        for stray in audit.strays:
            out.print(f"belongs to no part of the run: {stray}", highlight=False, markup=False, soft_wrap=True)
        for problem in audit.problems:
            out.print(f"damaged: {problem}", soft_wrap=True)
    if not audit.ok:
        raise typer.Exit(DAMAGED)


@app.command("copy")
def copy(
    run: RunFolder,
    out_folder: Annotated[str, typer.Argument(metavar="OUT", help="Folder or URL for the copy.")],
    pictures: Annotated[bool, typer.Option("--pictures", help="Copy frames and videos too.")] = False,
    partial: Partial = False,
) -> None:
    """Copy a run without its activations: outcomes, probes, interventions and certificates."""
    from probe_kit.runs import copy_run

    with err.status("copying"):
        out.print(str(copy_run(run, out_folder, pictures, partial).location), soft_wrap=True)


@app.command("export")
def export(
    run: RunFolder,
    style: Annotated[
        ExportFormat,
        typer.Option(
            "--format",
            help="Format. lerobot and sae write a folder; lerobot needs a run with --frames all. directions: for "
            "intervene --direction FILE#NAME.",
        ),
    ],
    out_file: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="What to write. Default: <run>.<format> beside the run."),
    ] = None,
    sites: Annotated[
        Names | None,
        typer.Option(
            "--sites",
            **LISTED,
            help="Of parquet, sae and directions: sites, such as backbone.07, expert or expert.*@9. Default: all.",
        ),
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(
            "--view",
            help="Of parquet, sae and directions: a pooled view, tokens or tokens:ROLE. Default: all pooled "
            "views, or mean in sae.",
        ),
    ] = None,
    dtype: Annotated[SaeDtype, typer.Option("--dtype", help="Of sae: type of the memory maps.")] = "bfloat16",
    seed: Annotated[int, typer.Option("--seed", help="Of sae: seed of the order of rows.")] = 0,
    partial: Partial = False,
) -> None:
    """Write a run for other tools: to a file, and its sha256 beside it, or to a folder."""
    from probe_kit.runs import export_run
    from probe_kit.runs.store import locate

    location = locate(run)
    target = out_file or location.path_of_export(f"{location.name}.{DIRECTION_FILES.get(style, style)}")
    with err.status("exporting"):
        written = export_run(location, style, target, partial, sites=sites, view=view, dtype=dtype, seed=seed)
    out.print(str(written), soft_wrap=True)
