"""`probe-kit targets` and `probe-kit labels`: what can be probed in a run, and a table to add to."""

from collections.abc import Iterator
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from probe_kit._system.counting import counted
from probe_kit._tables.numbers import NONE
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
    every = list(listed_targets(opened))
    listed = [row for row in every if row.task != CONSTANT]
    rows = [(row.target, row.task, row.per, row.values_in_words) for row in listed]
    columns, numbers = ("target", "task", "per", "values"), tuple(row._asdict() for row in every)
    print_table(
        Table.of(f"{opened.label}: what can be decoded", columns, rows, numbers=numbers, overflow="wrap"), style
    )
    if constant := [row.target for row in every if row.task == CONSTANT]:
        say(marked("one value only, so that there is nothing to decode: {}", ", ".join(constant)))
    # Those that need no further option come first, and what is not possible is never the next step.
    possible = sorted((row for row in listed if row.is_possible), key=lambda row: row.task == DOUBTFUL)
    if not possible:
        say(marked("next: [bold]probe-kit labels {}[/] writes a table to which you add labels of your own", run))
        return
    first = possible[0]
    as_task = f" --task {'continuous' if first.too_few_groups else 'classes'}" * (first.task == DOUBTFUL)
    options = "" if first.target == CORRECT else f" --target {first.target}{as_task}"
    say(marked("next: [bold]probe-kit train {}{}[/]", run, options))


DOUBTFUL = "classes or continuous"
"""The task of a few integers, which `--task` decides."""
CONSTANT = "one value"
"""In place of a task, of a column in which there is nothing to decode."""


class ListedTarget(NamedTuple):
    """A target in words. per: `episode` or `inference`. values: classes or range, or why the run has none.

    task: `CONSTANT` of a single value. too_few_groups: of its rarest class, empty where there are enough.
    """

    target: str
    task: str
    per: str
    values: str
    too_few_groups: str = ""

    @property
    def values_in_words(self) -> str:
        """Classes or range, and the groups that are too few."""
        return "; ".join(filter(None, (self.values, self.too_few_groups)))

    @property
    def is_possible(self) -> bool:
        """Whether probes can be trained on it, with `--task` where that decides."""
        return self.task == DOUBTFUL or (self.task not in (NONE, CONSTANT) and not self.too_few_groups)


def listed_targets(run: "RunReader") -> Iterator[ListedTarget]:
    """Yield every target of a run, those too that it cannot give."""
    from probe_kit.train.columns.builtin import BuiltinColumns
    from probe_kit.train.target import Target

    columns = BuiltinColumns(run)
    for name in [*(SIDES if run.inputs is None else ()), *columns.names]:
        try:
            if name in SIDES:
                target, task = Target.of_run(run, name), "binary"
            elif (column := columns.read(name)).is_constant:
                yield ListedTarget(name, CONSTANT, NONE, NONE)
                continue
            else:
                target, task = _target_and_task(name, column)
        except ProbeKitError as error:
            yield ListedTarget(name, NONE, NONE, str(error))
        else:
            per, few = "inference" if target.per_step else "episode", _too_few_groups(run, target)
            yield ListedTarget(name, task, per, target.values_in_words, few)


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
