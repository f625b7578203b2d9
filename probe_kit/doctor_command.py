"""`probe-kit doctor`."""

from typing import TYPE_CHECKING

import typer

from probe_kit._terminal.console import err, markup, out, print_json, say
from probe_kit._terminal.options import AsJson

if TYPE_CHECKING:
    from probe_kit.doctor import CheckResult


def doctor(
    as_json: AsJson = False,
) -> None:
    """Check the installation and suggest fixes; exit with 1 if the demo cannot run."""
    from probe_kit.doctor import examine

    with err.status("checking the installation"):
        findings = examine()
    if as_json:
        print_json([finding.to_json() for finding in findings])
    else:
        _print_findings(findings)
    missing = any(finding.state == "missing" for finding in findings)
    if not missing:
        commands = "probe-kit demo", "probe-kit diagnose MODEL"
        say(markup("next: [bold]{}[/]; [bold]{}[/] says which inputs a policy uses", *commands))
    raise typer.Exit(1 if missing else 0)


def _print_findings(findings: "list[CheckResult]") -> None:
    from probe_kit._tables.table import Cell, Table

    rows = [
        (
            Cell(finding.state, alarm=finding.state == "missing", strong=finding.state == "note"),
            finding.subject,
            "\n".join(filter(None, (finding.result, finding.advice))),
        )
        for finding in findings
    ]
    out.print(Table.of("the installation", ("state", "subject", "result"), rows, overflow="wrap"))
