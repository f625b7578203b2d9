"""`probe-kit labels`, and `probe-kit train` for a label of one's own."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from probe_kit._system.counting import counted
from probe_kit._terminal import options as common
from probe_kit._terminal.console import counter, marked, out, progress, say
from probe_kit.errors import UsageError
from probe_kit.train.choices import TARGETS, Task

if TYPE_CHECKING:
    from probe_kit.train import LabelResults, Labels, RunReader


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
    from probe_kit._system.csv_text import csv_of_frame
    from probe_kit._system.drafts import draft_of
    from probe_kit.runs import open_run
    from probe_kit.train.labels.builtin_columns import label_frame, why_no_sim

    if out_file.exists():
        raise UsageError(f"{out_file} exists; choose another --out or remove it")
    opened = open_run(run, allow_partial=partial).in_wording(wording)
    if len(opened.episodes) == 0:
        raise UsageError(f"{opened.location} has no finished episode to label. Finish it first")
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


@dataclass(frozen=True)
class ColumnOptions:
    """Options of `train` that name a label column, of a table or built in."""

    target: str
    file: Path | None
    task: Task | None
    group_by: str | None
    exchange_within: str | None
    align_to: str | None = None

    @classmethod
    def of(
        cls,
        target: str,
        file: Path | None,
        task: Task | None,
        group_by: str | None,
        exchange_within: str | None,
        window: int | None,
        align_to: str | None = None,
    ) -> "ColumnOptions | None":
        """The options; None where `target` is a side. Raises UsageError for a target that nothing names."""
        from probe_kit.train.labels.builtin_columns import builtin_names, is_builtin

        if file is None and target in TARGETS:
            further = {"--task": task, "--group-by": group_by, "--exchange-within": exchange_within}
            given = [
                name
                for name, value in {**further, "--window": window, "--align-to": align_to}.items()
                if value is not None
            ]
            if given:
                raise UsageError(
                    f"{given[0]} is for labels of your own; give --labels FILE and --target COLUMN too"
                )
            return None
        if file is None and not is_builtin(target):
            sides = ", ".join(map(repr, TARGETS))
            raise UsageError(
                f"--target {target!r} is not one of {sides}, nor a built-in column ({', '.join(builtin_names())})."
                " Give the table of another column with --labels FILE"
            )
        if file is not None and target in TARGETS:
            raise UsageError(
                f"--target {target} is a side, and --labels {file} is given. Name a column of the table with "
                "--target; rename the column if it is called so"
            )
        return cls(target, file, task, group_by, exchange_within, align_to)

    def read(self, run: "RunReader", file: Path | None = None) -> "Labels":
        """The labels of a run: of the table, of another `file`, or built in."""
        from probe_kit.train import Labels

        further = self.task, self.group_by, self.exchange_within
        if (table := file or self.file) is None:
            return Labels.of_run(run, self.target, *further)
        return Labels.read(table, self.target, *further)

    def event(self, run: "RunReader") -> "Labels | None":
        """The column where windows begin, built in or of the table; of `COLUMN=VALUE` whether it has the value."""
        from probe_kit.train import Labels
        from probe_kit.train.labels.builtin_columns import is_builtin

        if self.align_to is None:
            return None
        name, equals, value = self.align_to.partition("=")
        found = Labels.of_run(run, name) if self.file is None or is_builtin(name) else Labels.read(self.file, name)
        return found.equal_to(value) if equals else found


@dataclass(frozen=True)
class TransferOptions:
    """Options of `train` that name a run to score probes on."""

    run: str
    labels: Path | None
    across_weights: bool

    @classmethod
    def of(
        cls, run: str | None, labels: Path | None, across_weights: bool, column: ColumnOptions | None
    ) -> "TransferOptions | None":
        """The options; None without `--test-on`. Raises UsageError where one needs another."""
        if run is None:
            if labels is not None or across_weights:
                given = "--test-labels" if labels is not None else "--across-weights"
                raise UsageError(f"{given} is for a transfer; give --test-on RUN too, or leave it out")
            return None
        if column is None:
            raise UsageError(
                "--test-on scores probes of a label; name one with --target COLUMN, built in or of --labels FILE"
            )
        if labels is not None and column.file is None:
            raise UsageError("--test-labels with a built-in column; give --labels FILE too, or leave it out")
        return cls(run, labels, across_weights)


def _one_call(call: str) -> int:
    if not call.isdecimal():
        raise UsageError(
            f"--call {call!r} with a label of your own; expected one number. Use --window for several"
        )
    return int(call)


def train_on_column(
    run: "RunReader",
    column: ColumnOptions,
    categories: Any,
    call: str,
    controls: Any,
    window: int | None,
    options: Mapping[str, Any],
) -> "LabelResults":
    """Probe `run` for a label column, with a progress bar; see `train_probes`."""
    from probe_kit.train import train_probes

    number, labels = _one_call(call), column.read(run)
    _print_contents(labels)
    with progress() as bar:
        return train_probes(
            run,
            categories,
            labels=labels,
            call=number,
            window=window,
            align_to=column.event(run),
            controls=controls,
            progress=counter(bar, "sites"),
            **options,
        )


def _print_contents(labels: "Labels") -> None:
    out.print(labels.contents, markup=False, highlight=False)


def transfer_column(
    run: "RunReader",
    other: "RunReader",
    column: ColumnOptions,
    transfer: TransferOptions,
    categories: Any,
    call: str,
    window: int | None,
    options: Mapping[str, Any],
    details: bool,
) -> None:
    """Fit probes of a label column on `run`, score them on `other` with a progress bar, and print the scores."""
    from probe_kit.train import transfer_probes
    from probe_kit.train.transfer.transfer_summary import transfer_sentences, transfer_table

    fitted_on, scored_on = column.read(run), column.read(other, transfer.labels)
    _print_contents(fitted_on)
    if scored_on.contents != fitted_on.contents:
        _print_contents(scored_on)
    with progress() as bar:
        results = transfer_probes(
            run,
            other,
            fitted_on,
            scored_on,
            categories,
            call=_one_call(call),
            window=window,
            across_weights=transfer.across_weights,
            progress=counter(bar, "sites"),
            **options,
        )
    out.print(transfer_table(results, splits=details))
    for sentence in transfer_sentences(results):
        out.print(sentence, markup=False, highlight=False)
    say(marked("nothing was stored; [bold]transfer_probes[/] in Python gives every site as a frame"))


def print_label_results(run: str, results: "LabelResults", details: bool) -> None:
    """The table and the sentences of probes of a label."""
    from probe_kit.train.labels.label_summary import label_sentences, label_table

    out.print(label_table(results, splits=details))
    for sentence in label_sentences(results):
        out.print(sentence, markup=False, highlight=False)
    target = shlex.quote(results.settings.target)
    say(
        marked(
            "next: [bold]probe-kit retention {} --target {} --html report.html[/]; in Python "
            "[bold]load_label_results(run, '{}')[/] gives every site as a frame",
            run, target, results.key,
        )
    )  # fmt: skip
