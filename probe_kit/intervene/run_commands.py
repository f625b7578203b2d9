"""`probe-kit run list`: the runs below a folder, a line each."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from probe_kit._system.counting import counted
from probe_kit._tables.numbers import whole_percent
from probe_kit._tables.printing import Format, print_table
from probe_kit._tables.table import Table
from probe_kit._terminal.console import marked, out, print_json, say
from probe_kit._terminal.options import AsJson, Partial, RunFolder
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.runs import Run


_COLUMNS = ("run", "model", "suite", "episodes", "correct", "probes", "interventions")
"""Facts that are shown, by their names."""


def list_runs(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A folder that holds runs, at any depth.")],
    style: Format = "table",
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
    print_table(_table(lines, folder), style)
    for line in lines:
        if "error" in line:
            say(marked("[yellow]{} cannot be read: {}[/]", line["run"], line["error"]))


def _facts(run: "Run") -> dict[str, Any]:
    from probe_kit.intervene.results.inventory import listed_interventions
    from probe_kit.runs.reader import full_name
    from probe_kit.train.results.inventory import inventory

    outcomes = run.episodes.get("outcome")
    judged = outcomes is not None and len(outcomes) > 0 and set(outcomes) <= {"correct", "wrong", "oob"}
    return {
        "model": full_name(run.label, run.random_weights),
        "suite": run.suite,
        "episodes": len(run.episodes),
        "correct": float((outcomes == "correct").mean()) if judged and outcomes is not None else None,
        "probes": len(inventory(run).probes),
        "interventions": len(listed_interventions(run)),
    }


def _table(lines: list[dict[str, Any]], folder: Path) -> Table:
    """The runs that can be read, a line each; the numbers name the others too."""
    rows = []
    for line in lines:
        if "error" not in line:
            # Hashes stay in the numbers: they would take the room of names.
            suite = line["suite"].partition("#")[0]
            texts = {**line, "correct": whole_percent(line["correct"]), "suite": suite}
            rows.append([str(texts[name]) for name in _COLUMNS])
    headings = ["correct %" if name == "correct" else name for name in _COLUMNS]
    return Table.of(f"runs below {folder}", headings, rows, numbers=tuple(lines), overflow="wrap")


def show(
    run: RunFolder,
    label: Annotated[
        str | None,
        typer.Option(
            "--label",
            metavar="TEXT",
            help="First give the run this label, as tables and figures name it. Numbers, hashes and probes stay "
            "as they are.",
        ),
    ] = None,
    action_errors: Annotated[
        bool,
        typer.Option(
            "--action-errors",
            help="Of a run on recordings: compare the actions that the model predicted with the recorded ones.",
        ),
    ] = False,
    partial: Partial = False,
    as_json: AsJson = False,
) -> None:
    """List the episodes, streams, probes and interventions of a run; the last two by key.

    With --action-errors, errors are in standard deviations of the recorded actions at the shown frames: the mean
    recorded action has an error of 1. `--json` prints every episode too; `probe-kit labels RUN` writes the
    error of every frame. An unfinished run needs --partial for it.
    """
    from probe_kit.intervene.results.inventory import listed_interventions
    from probe_kit.runs import label_run, open_run
    from probe_kit.runs.layout import INTERVENTIONS
    from probe_kit.runs.provenance import input_notes
    from probe_kit.runs.results import unfinished_bundles
    from probe_kit.train.commands import facts_table
    from probe_kit.train.results.inventory import inventory
    from probe_kit.train.results.store import how_to_probe

    if partial and not action_errors:
        raise UsageError("--partial is for --action-errors; `run show` lists unfinished runs too. Leave it out")
    if label is not None:
        label_run(run, label)
    if action_errors:
        _show_action_errors(run, partial, as_json)
        return
    opened = open_run(run, allow_partial=True)
    facts, interventions = inventory(opened), listed_interventions(opened)
    unfinished = unfinished_bundles(opened.location, INTERVENTIONS)
    notes = input_notes(opened.certificate) if facts.episodes else []
    if as_json:
        listed = [asdict(intervention) for intervention in interventions]
        print_json(
            {
                **asdict(facts),
                "interventions": listed,
                "unfinished_interventions": unfinished,
                "input_notes": notes,
            }
        )
        return
    rows = {"inputs": "; ".join(notes)}
    rows |= {f"intervention {intervention.key}": intervention.words for intervention in interventions}
    rows |= {
        f"unfinished {key}": f"an intervention, {counted(items, 'item')} so far; "
        "the same `probe-kit intervene` continues it"
        for key, items in unfinished.items()
    }
    out.print(facts_table(facts, rows))
    if not facts.probes:
        why = f". {how_to_probe(opened)}" if facts.streams else ": a policy without streams has none"
        out.print(f"no probes{why}", soft_wrap=True)


def _show_action_errors(run: str, partial: bool, as_json: bool) -> None:
    """Print how predicted actions differ from the recorded ones. Raises what `compare_actions` raises."""
    from probe_kit.runs import compare_actions, open_run
    from probe_kit.runs.action_errors import action_error_table

    errors = compare_actions(open_run(run, allow_partial=partial))
    if as_json:
        print_json({"run": run, "numbers": _plain(errors.by_number), "episodes": _plain(errors.by_episode)})
    else:
        out.print(action_error_table(errors))


def _plain(frame: "pd.DataFrame") -> list[dict[str, Any]]:
    """Return the lines of a frame as JSON has them: NaN is null."""
    rows = frame.to_dict("records")
    return [{str(name): None if value != value else value for name, value in row.items()} for row in rows]
