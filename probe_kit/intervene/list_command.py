"""`probe-kit run list`: the runs below a folder, a line each."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from probe_kit._terminal.console import out, print_json
from probe_kit._terminal.options import AsJson
from probe_kit._terminal.plain_text import terminal_safe

if TYPE_CHECKING:
    from probe_kit.runs import Run

_COLUMNS = ("run", "model", "suite", "episodes", "correct %", "probes", "interventions")


def list_runs(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A folder that holds runs, at any depth.")],
    as_json: AsJson = False,
) -> None:
    """List the runs below a folder: model, suite, episodes, and how many probes and interventions each has.

    `probe-kit view FOLDER` opens them all. A run that cannot be read is named with the reason.
    """
    from probe_kit.errors import ProbeKitError
    from probe_kit.runs import open_run
    from probe_kit.runs.run_folders import find_runs

    lines: list[dict[str, Any]] = []
    for path in find_runs(folder):
        name = "." if path == folder else str(path.relative_to(folder))
        try:
            lines.append({"run": name, **_facts(open_run(path, allow_partial=True))})
        except ProbeKitError as error:
            lines.append({"run": name, "error": f"{type(error).__name__}: {error}"})
    if as_json:
        print_json(lines)
        return
    _print(lines)


def _facts(run: "Run") -> dict[str, Any]:
    from probe_kit.intervene.results.inventory import listed_interventions
    from probe_kit.train.results.inventory import inventory

    outcomes = run.episodes.get("outcome")
    judged = outcomes is not None and len(outcomes) > 0 and set(outcomes) <= {"correct", "wrong", "oob"}
    return {
        "model": run.label,
        "suite": run.suite,
        "episodes": len(run.episodes),
        "correct": float((outcomes == "correct").mean()) if judged and outcomes is not None else None,
        "probes": len(inventory(run).probes),
        "interventions": len(listed_interventions(run)),
    }


def _print(lines: list[dict[str, Any]]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False)
    for column in _COLUMNS:
        table.add_column(column, overflow="fold", justify="left" if column in _COLUMNS[:3] else "right")
    for line in lines:
        if "error" in line:
            continue
        correct = "–" if line["correct"] is None else f"{100 * line['correct']:.0f}"
        cells = (
            line["run"],
            line["model"],
            line["suite"],
            line["episodes"],
            correct,
            line["probes"],
            line["interventions"],
        )
        table.add_row(*(Text(terminal_safe(str(cell))) for cell in cells))
    out.print(table)
    for line in lines:
        if "error" in line:
            out.print(Text(terminal_safe(f"{line['run']} cannot be read: {line['error']}"), style="yellow"))
