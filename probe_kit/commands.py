"""`probe-kit demo` and `probe-kit doctor`, which belong to no package."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit.console import counter, err, marked, out, print_json, progress

if TYPE_CHECKING:
    from probe_kit.doctor import Finding


def demo(
    out_folder: Annotated[Path, typer.Option("--out", help="Folder for everything the demo makes.")] = Path(
        "probe-kit-demo"
    ),
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="Test the instrument instead: policies of which the truth is known, expected beside measured.",
        ),
    ] = False,
) -> None:
    """Run the whole pipeline on the embedded models: answers, episodes, activations, probes, retention.

    Takes under 4 minutes on 2 cores and downloads nothing. With --compare it does so for every policy of which the
    truth is known, and takes about six times as long.
    """
    from probe_kit.demo import compare_organisms, run_demo

    if compare:
        from probe_kit.organisms import to_rich

        with progress() as bar:
            findings = compare_organisms(out_folder, lambda stage: counter(bar, stage))
        out.print(to_rich(findings))
        if not all(finding.agrees for finding in findings):
            raise typer.Exit(1)
        return
    with progress() as bar:
        made = run_demo(out_folder, lambda stage: counter(bar, stage))
    out.print(made.story.to_rich())
    out.print(made.table.to_rich())
    out.print(made.next_steps(), soft_wrap=True)


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
) -> None:
    """Say what works on this machine, and what to do about the rest; exit 1 if the demo could not run."""
    from probe_kit.doctor import examine

    with err.status("looking around"):
        findings = examine()
    if as_json:
        print_json([finding.to_json() for finding in findings])
    else:
        _print_findings(findings)
    raise typer.Exit(1 if any(finding.state == "missing" for finding in findings) else 0)


def _print_findings(findings: "list[Finding]") -> None:
    from rich.table import Table
    from rich.text import Text

    colours = {"ok": "green", "note": "yellow", "missing": "red"}
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in findings:
        advice = marked("\n[dim]{}[/]", finding.advice) if finding.advice else ""
        mark = marked(f"[{colours[finding.state]}]{{}}[/]", finding.state)
        table.add_row(mark, finding.subject, Text.assemble(finding.seen, advice))
    out.print(table)
