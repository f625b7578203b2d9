"""`probe-kit targets` and `probe-kit labels`: what can be probed in a run, and a table to add to."""

from collections.abc import Iterator
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit._system.counting import counted
from probe_kit._tables.printing import Format, print_table
from probe_kit._tables.table import Table
from probe_kit._terminal import options as common
from probe_kit._terminal.console import marked, out, say
from probe_kit.errors import ProbeKitError, UsageError
from probe_kit.train.choices import CORRECT, SIDES

if TYPE_CHECKING:
    from probe_kit.runs import Run
    from probe_kit.train import RunReader, Target
    from probe_kit.train.columns.builtin import BuiltinColumn


def targets(
    run: common.RunFolder,
    wording: common.Wording = None,
    style: Format = "table",
    partial: common.Partial = False,
) -> None:
    """List what can be probed in a run: sides and built-in columns, with their classes or range.

    Decode one with `probe-kit train RUN --target NAME`. Tables of your own give further ones, see `probe-kit
    labels`.
    """
    opened = _open(run, partial, wording)
    every, columns = list(listed_targets(opened)), ("target", "task", "per", "values")
    listed = [row for row in every if row[1] != CONSTANT]
    numbers = [dict(zip((*columns, "too_few_groups"), row, strict=True)) for row in every]
    rows = [(*cells[:-1], "; ".join(filter(None, (cells[-1], few)))) for *cells, few in listed]
    print_table(
        Table.of(f"{opened.label}: what can be decoded", columns, rows, numbers=tuple(numbers), overflow="wrap"),
        style,
    )
    if constant := [name for name, task, *_ in every if task == CONSTANT]:
        say(marked("one value only, so that there is nothing to decode: {}", ", ".join(constant)))
    # Those that need no further option come first, and what is not possible is never the next step.
    possible = sorted(
        (row for row in listed if row[1] == DOUBTFUL or (row[1] != "–" and not row[-1])),
        key=lambda row: row[1] == DOUBTFUL,
    )
    if not possible:
        say(marked("next: [bold]probe-kit labels {}[/] writes a table to which you add labels of your own", run))
        return
    name, task, *_, few = possible[0]
    as_task = f" --task {'continuous' if few else 'classes'}" * (task == DOUBTFUL)
    options = "" if name == CORRECT else f" --target {name}{as_task}"
    say(marked("next: [bold]probe-kit train {}{}[/]", run, options))


DOUBTFUL = "classes or continuous"
"""The task of a few integers, which `--task` decides."""
CONSTANT = "one value"
"""In place of a task, of a column in which there is nothing to decode."""


def listed_targets(run: "RunReader") -> Iterator[tuple[str, str, str, str, str]]:
    """Yield name, task, `episode` or `inference`, classes or range, and groups that are too few, of every target.

    One that the run cannot give has the reason in place of the classes, one of a single value the task `CONSTANT`.
    """
    from probe_kit.train.columns.builtin import BuiltinColumns
    from probe_kit.train.target import Target

    columns = BuiltinColumns(run)
    for name in [*(SIDES if run.inputs is None else ()), *columns.names]:
        try:
            if name in SIDES:
                target, task = Target.of_run(run, name), "binary"
            elif (column := columns.read(name)).is_constant:
                yield name, CONSTANT, "–", "–", ""
                continue
            else:
                target, task = _target_and_task(name, column)
        except ProbeKitError as error:
            yield name, "–", "–", str(error), ""
        else:
            per, few = "inference" if target.per_step else "episode", _too_few_groups(run, target)
            yield name, task, per, target.values_in_words, few


def _too_few_groups(run: "RunReader", target: "Target") -> str:
    """Return the groups of the rarest class, where `train` refuses a target with so few; empty for others."""
    from probe_kit.statistics.sufficiency import GROUPS_FOR_PROBES

    group_of = dict(zip(run.episodes["episode_id"].astype(str), run.episodes["group_id"], strict=True))
    groups: dict[float, set[str]] = {}
    for episode, value in zip(target.episodes, target.coded.values, strict=True):
        if isfinite(value) and episode in group_of:
            groups.setdefault(value if target.coded.classes else 0.0, set()).add(str(group_of[episode]))
    rarest = min(groups, key=lambda value: len(groups[value]), default=None)
    if rarest is None or len(groups[rarest]) >= GROUPS_FOR_PROBES:
        return ""
    subject = f"{target.coded.classes[int(rarest)]} in " if target.coded.classes else ""
    return f"{subject}{counted(len(groups[rarest]), 'group')}, {GROUPS_FOR_PROBES} needed"


def _target_and_task(name: str, column: "BuiltinColumn") -> "tuple[Target, str]":
    """Return the target of a built-in column, and its task in words."""
    from probe_kit.train.target import Target

    try:
        target = Target.of_column(name, column)
    except UsageError as error:
        try:
            return Target.of_column(name, column, "classes"), DOUBTFUL
        except UsageError:
            raise error from None
    return target, target.task


def labels(
    run: common.RunFolder,
    out_file: Annotated[Path, typer.Option("--out", metavar="FILE", help="CSV file to write.")] = Path(
        "labels.csv"
    ),
    wording: common.Wording = None,
    partial: common.Partial = False,
) -> None:
    """Write a table to which you add label columns of your own.

    The table has a line per episode and captured inference, with the built-in columns that `train --target` knows.
    Add a column, and decode it with `probe-kit train RUN --labels FILE --target COLUMN`.
    """
    from probe_kit._system.drafts import draft_of
    from probe_kit._system.escaping import csv_of_frame
    from probe_kit.train.columns.builtin import label_frame, why_no_sim

    if out_file.exists():
        name = f"{out_file.stem}-{Path(run).name}{out_file.suffix}"
        raise UsageError(f"{out_file} exists and may hold labels of yours; write to another file, as --out {name}")
    opened = _open(run, partial, wording)
    frame = label_frame(opened)
    with draft_of(out_file) as draft:
        draft.write_text(csv_of_frame(frame), encoding="utf-8", newline="\n")
        draft.rename(out_file)
    out.print(
        f"{out_file}: {counted(len(frame), 'line')}, columns {', '.join(map(str, frame))}",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    if opened.inputs is None and (reason := why_no_sim(opened)):
        say(marked("[yellow]no sim.* columns:[/] {}", reason))
    say(marked("next: add a column, then [bold]probe-kit train {} --labels {} --target COLUMN[/]", run, out_file))


def _open(run: str, partial: bool, wording: str | None) -> "Run":
    from probe_kit.runs import open_run

    opened = open_run(run, allow_partial=partial).in_wording(wording)
    if len(opened.episodes) == 0:
        raise UsageError(f"{opened.location} has no finished episode to label. Finish it first")
    return opened
