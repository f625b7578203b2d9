"""`probe-kit demo`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit._terminal.console import counter, out, progress

if TYPE_CHECKING:
    from probe_kit.demo.pipeline import Demo


def demo(
    out_folder: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="Folder for the results.")] = Path(
        "probe-kit-demo"
    ),
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="Check probe-kit itself: play policies whose true verdict is known, and print "
            "expected and measured "
            "verdicts. The exit code is 1 if a verdict is wrong; undecided verdicts are counted separately.",
        ),
    ] = False,
    full: Annotated[
        bool,
        typer.Option(
            "--full", help="Use 24 items of 4 categories and 200 permutations, as --compare does. Takes longer."
        ),
    ] = False,
) -> None:
    """Run the whole pipeline on the embedded models: answers, episodes, activations, probes, retention.

    Takes 1 to 2 minutes on 2 cores and downloads nothing. --full takes four times as long, --compare 20 times.
    """
    from probe_kit.demo.pipeline import FULL, QUICK, compare_organisms, run_demo

    if compare:
        from probe_kit.demo.pipeline import organism_table

        with progress() as bar:
            findings = compare_organisms(out_folder, lambda stage: counter(bar, stage))
        out.print(organism_table(findings))
        if any(finding.agreement == "wrong" for finding in findings):
            raise typer.Exit(1)
        return
    with progress() as bar:
        products = run_demo(out_folder, lambda stage: counter(bar, stage), FULL if full else QUICK)
    print_demo(products)


def print_demo(products: "Demo") -> None:
    """Print where to look, then the table and a sentence per category, and last the command for the viewer."""
    out.print(products.next_steps(), soft_wrap=True)
    out.print()
    out.print(products.table.to_rich(with_next_step=False))
    out.print(products.viewer(), soft_wrap=True)
