"""The commands `probe-kit targets` and `probe-kit labels`: what can be probed in a run, and a table to add to."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple
from warnings import catch_warnings, simplefilter

import typer

from probe_kit._system.counting import plural
from probe_kit._system.escaping import as_argument
from probe_kit._tables.numbers import NONE
from probe_kit._tables.printing import Format, print_table
from probe_kit._tables.table import Table
from probe_kit._terminal import options as common
from probe_kit._terminal.console import markup, out, say
from probe_kit.errors import ProbeKitError, UsageError
from probe_kit.train.choices import CORRECT, SIDES

if TYPE_CHECKING:
    from probe_kit.runs import Run
    from probe_kit.train import RunReader, Target
    from probe_kit.train.builtin_columns import BuiltinColumn


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
    rows = [(row.target, row.task, row.per, row.values) for row in listed]
    columns, numbers = ("target", "task", "per", "values"), tuple(row.to_json(str(run)) for row in every)
    print_table(
        Table.of(f"{opened.label}: what can be decoded", columns, rows, numbers=numbers, overflow="wrap"), style
    )
    if constant := [row.target for row in every if row.task == CONSTANT]:
        say(markup("one value only, so that there is nothing to decode: {}", ", ".join(constant)))
    refusals: dict[str, list[str]] = {}
    for row in listed:
        if row.refused:
            refusals.setdefault(row.refused, []).append(row.target)
    for reason, names in refusals.items():
        say(markup("[yellow]train refuses {}:[/] {}", ", ".join(names), reason))
    # Those that need no further option come first, and what is refused is never the next step.
    possible = sorted(
        (row.options for row in listed if row.options is not None), key=lambda options: "--task" in options
    )
    if not possible:
        say(
            markup(
                "next: [bold]probe-kit labels {}[/]  writes a table to which you add labels of your own",
                as_argument(run),
            )
        )
        return
    say(markup("next: [bold]{}[/]", _command(str(run), possible[0])))


def _command(run: str, options: Sequence[str]) -> str:
    """Return the command that trains probes, as it is typed."""
    return " ".join(["probe-kit train", as_argument(run), *map(shlex.quote, options)])


DOUBTFUL = "classes or continuous"
"""The task of a few integers, which `--task` decides."""
CONSTANT = "one value"
"""Text in place of a task, for a column in which there is nothing to decode."""


class ListedTarget(NamedTuple):
    """A target in words, and its numbers.

    Attributes:
        task: `CONSTANT` for a column with a single value.
        per: `episode` or `inference`.
        values: Classes or range, or why the run has none.
        options: Options of the command that trains probes on it; None where `train` refuses every one.
        refused: Reason why `train` refuses every one; empty where it does not.
        counts: Counts by class or the range, see `Target.value_counts`; empty where the run has none.
    """

    target: str
    task: str
    per: str
    values: str
    options: tuple[str, ...] | None = None
    refused: str = ""
    counts: Mapping[str, Any] = MappingProxyType({})

    def to_json(self, run: str) -> dict[str, Any]:
        """Return plain values: tasks that fit, counts, and the command or why there is none; no empty ones."""
        tasks = {DOUBTFUL: ["classes", "continuous"], CONSTANT: [], NONE: []}.get(self.task, [self.task])
        reason = self.refused or ("" if self.counts else self.values if self.values != NONE else self.task)
        return {
            "target": self.target,
            "tasks": tasks,
            **({"per": self.per, "values": dict(self.counts)} if self.counts else {}),
            **({} if self.options is None else {"command": _command(run, self.options)}),
            **({"refused": reason} if reason else {}),
        }


def listed_targets(run: "RunReader") -> Iterator[ListedTarget]:
    """Yield every target of a run, including those that it cannot give."""
    from probe_kit.train.builtin_columns import BuiltinColumns

    columns = BuiltinColumns(run)
    for name in [*(SIDES if run.inputs is None else ()), *columns.names]:
        try:
            if name not in SIDES and (column := columns.read(name)).is_constant:
                yield ListedTarget(name, CONSTANT, NONE, NONE)
                continue
            target, task, trials = (
                _trials_of_a_side(run, name) if name in SIDES else _trials_of_a_column(name, column)
            )
        except ProbeKitError as error:
            yield ListedTarget(name, NONE, NONE, str(error))
            continue
        reasons = {options: _refusal(run, *trial) for options, trial in trials.items()}
        options = next((options for options, reason in reasons.items() if not reason), None)
        refused = "" if options is not None else next(iter(reasons.values()))
        per = "inference" if target.per_step else "episode"
        yield ListedTarget(name, task, per, target.values_in_words, options, refused, target.value_counts)


Trials = tuple["Target", str, dict[tuple[str, ...], tuple["Target", Sequence[str] | None]]]
"""A target, its task in words, and by the options of `train` the target and categories that these give."""


def _trials_of_a_side(run: "RunReader", name: str) -> Trials:
    """Return the options that train a side: of all categories, or of those with enough groups."""
    from probe_kit.statistics.sufficiency import GROUPS_FOR_PROBES
    from probe_kit.train.target import Target

    target, option = Target.of_run(run, name), () if name == CORRECT else ("--target", name)
    trials: dict[tuple[str, ...], tuple[Target, Sequence[str] | None]] = {option: (target, None)}
    groups = run.episodes.groupby("category", sort=False)["group_id"].nunique()
    enough = [str(category) for category, count in groups.items() if count >= GROUPS_FOR_PROBES]
    if enough and len(enough) < len(groups):
        trials["--categories", ",".join(enough), *option] = target, enough
    return target, "binary", trials


def _trials_of_a_column(name: str, column: "BuiltinColumn") -> Trials:
    """Return the options that train a column: with each task that a few integers may have."""
    from probe_kit.train.target import Target

    try:
        target = Target.of_column(name, column)
    except UsageError as error:
        try:
            classes = Target.of_column(name, column, "classes")
        except UsageError:
            raise error from None
        quantities, option = Target.of_column(name, column, "continuous"), ("--target", name, "--task")
        return (
            classes,
            DOUBTFUL,
            {(*option, "classes"): (classes, None), (*option, "continuous"): (quantities, None)},
        )
    return target, target.task, {("--target", name): (target, None)}


def _refusal(run: "RunReader", target: "Target", categories: Sequence[str] | None) -> str:
    """Return why `train` refuses a target, by its own checks before any probe is fitted; empty if it does not."""
    from probe_kit.train.probe_sweep import ProbeSweep

    try:
        with catch_warnings():
            simplefilter("ignore")  # train says them where they matter
            _ = ProbeSweep.of(run, target, categories, views=("mean",), permutations=0, seed=0).problems
    except ProbeKitError as error:
        # Lines of targets that are refused for one reason are printed as one.
        return str(error).removeprefix(f"label {target.name!r}: ")
    return ""


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
    from probe_kit.train.builtin_columns import label_frame, why_no_sim

    if out_file.exists():
        name = f"{out_file.stem}-{Path(run).name}{out_file.suffix}"
        raise UsageError(f"{out_file} exists and may hold labels of yours; write to another file, as --out {name}")
    opened = _open(run, partial, wording)
    frame = label_frame(opened)
    with draft_of(out_file) as draft:
        draft.write_text(csv_of_frame(frame), encoding="utf-8", newline="\n")
        draft.rename(out_file)
    out.print(
        f"{out_file}: {plural(len(frame), 'line')}, columns {', '.join(map(str, frame))}",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    if opened.inputs is None and (reason := why_no_sim(opened)):
        say(markup("[yellow]no sim.* columns:[/] {}", reason))
    say(
        markup(
            "next: add a column, then [bold]probe-kit train {} --labels {} --target COLUMN[/]",
            as_argument(run),
            as_argument(out_file),
        )
    )


def _open(run: str, partial: bool, wording: str | None) -> "Run":
    from probe_kit.runs import open_run

    opened = open_run(run, allow_partial=partial).in_wording(wording)
    if len(opened.episodes) == 0:
        raise UsageError(f"{opened.location} has no finished episode to label. Finish it first")
    return opened
