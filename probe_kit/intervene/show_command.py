"""`probe-kit run show`: a run, its probes and interventions, its label, and the errors of predicted actions."""

from dataclasses import asdict
from typing import Annotated

import typer

from probe_kit._terminal.console import out, print_json
from probe_kit._terminal.options import AsJson, Partial, RunFolder
from probe_kit.errors import UsageError


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
    from probe_kit.extract.source_commands.action_error_table import show_action_errors
    from probe_kit.intervene.results.inventory import listed_interventions, unfinished_interventions
    from probe_kit.runs import label_run, open_run
    from probe_kit.train.commands import facts_table
    from probe_kit.train.results.inventory import inventory
    from probe_kit.train.results.store import how_to_probe

    if partial and not action_errors:
        raise UsageError("--partial is for --action-errors; `run show` lists unfinished runs too. Leave it out")
    if label is not None:
        label_run(run, label)
    if action_errors:
        show_action_errors(run, partial, as_json)
        return
    opened = open_run(run, allow_partial=True)
    found, interventions = inventory(opened), listed_interventions(opened)
    unfinished = unfinished_interventions(opened.location)
    if as_json:
        listed = [asdict(one) for one in interventions]
        print_json({**asdict(found), "interventions": listed, "unfinished_interventions": unfinished})
        return
    further = {f"intervention {one.key}": one.words for one in interventions}
    further |= {
        f"unfinished {key}": f"an intervention, {items} items so far; the same `probe-kit intervene` continues it"
        for key, items in unfinished.items()
    }
    out.print(facts_table(found, further))
    if not found.probes:
        why = f". {how_to_probe(opened)}" if found.streams else ": a policy without streams has none"
        out.print(f"no probes{why}", soft_wrap=True)
