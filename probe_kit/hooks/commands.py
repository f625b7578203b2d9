"""`probe-kit verify` and `probe-kit new-adapter`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from probe_kit._terminal.console import err, out, print_json
from probe_kit._terminal.options import AsJson
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from probe_kit.hooks.verify import Verification


def verify(
    family: Annotated[str, typer.Argument(help="Model family; `probe-kit models` lists them.")],
    folder: Annotated[
        Path | None, typer.Argument(help="Folder that holds checkpoint/ and its recorded outputs, reference.npz.")
    ] = None,
    keys: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Text file of the full-size checkpoint's tensor names; the adapter's must be the same.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare an adapter with outputs recorded from the model's original implementation.

    Exits with 1 if an error exceeds its tolerance. Outputs that the adapter cannot produce are listed as not
    compared.
    """
    if (folder is None) == (keys is None):
        raise UsageError("give either a golden reference folder or --keys FILE")
    from probe_kit.hooks.verify import verify_keys, verify_reference

    verification = verify_keys(family, keys) if keys else verify_reference(family, cast("Path", folder))
    if as_json:
        print_json(verification.to_json())
    else:
        _print_verification(verification)
    raise typer.Exit(0 if verification.passed else 1)


def new_adapter(
    name: Annotated[str, typer.Argument(help="Name of your model family, such as my-vla.")],
    out_folder: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="New folder. Default: NAME.")
    ] = None,
) -> None:
    """Write a package with an adapter for your own model, its entry point and its contract test.

    The package contains a small example network and passes the contract test. Its README lists what to change.
    """
    from probe_kit._system.imports import install_folder_command
    from probe_kit.hooks.new_adapter import write_adapter

    for path in write_adapter(name, out_folder):
        out.print(str(path), highlight=False, markup=False, soft_wrap=True)
    folder = out_folder or Path(name)
    err.print(
        f"next: {install_folder_command(folder)}\nthen read {folder / 'README.md'}",
        highlight=False, markup=False, soft_wrap=True,
    )  # fmt: skip


def _print_verification(verification: "Verification") -> None:
    from probe_kit._tables.table import Cell, Table

    rows = []
    for c in verification.comparisons:
        error = Cell(None) if c.error is None else Cell(c.error, "{:.2e}".format)
        status = Cell(c.status, alarm=c.status == "over", strong=c.status == "not compared")
        rows.append((c.output, error, Cell(c.tolerance, "{:.0e}".format), status, c.note))
    columns = ("output", "max abs error", "tolerance", "", "note")
    out.print(Table.of(verification.family, columns, rows, overflow="wrap"))
