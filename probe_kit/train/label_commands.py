"""`probe-kit labels`: a table with the keys of a run, to be extended by label columns."""

from pathlib import Path
from typing import Annotated

import typer

from probe_kit._terminal import options as common
from probe_kit._terminal.console import marked, out, say
from probe_kit.errors import UsageError


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
    from probe_kit.extract import open_run
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
        f"{out_file}: {len(frame)} lines, columns {', '.join(map(str, frame))}",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    if reason := why_no_sim(opened):
        say(marked("[yellow]no sim.* columns:[/] {}", reason))
    say(marked("next: add a column, then [bold]probe-kit train {} --labels {} --target COLUMN[/]", run, out_file))
