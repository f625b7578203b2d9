"""What the commands share: two consoles, progress, comma-separated lists."""

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from probe_kit.heartbeat import Heartbeat

PAGE = 120
"""Columns of a table that goes to a file or a pipe, where no terminal says how many there are."""

out = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else PAGE)
"""Results: what a script would read."""
err = Console(stderr=True)
"""Progress, plans and notes."""


def split(text: str | None) -> tuple[str, ...] | None:
    """The parts of a comma-separated option; None stays None."""
    return None if text is None else tuple(part.strip() for part in text.split(",") if part.strip())


def print_json(value: Any) -> None:
    """Print `value` as JSON on stdout."""
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False))


@contextmanager
def progress() -> Iterator[Progress]:
    """Progress on stderr: bars in a terminal; elsewhere what `counter` gives says a line now and then."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err, disable=not err.is_terminal) as bar:
        yield bar


def counter(bar: Progress, description: str) -> Callable[..., None]:
    """A callback (done, total, …) that moves one bar of `bar`, or says lines where there is no terminal."""
    if not err.is_terminal:
        return Heartbeat(description, lambda line: err.print(line, highlight=False, markup=False, soft_wrap=True))
    task = bar.add_task(description, total=None)

    def advance(done: int, total: int, *_: object) -> None:
        bar.update(task, completed=done, total=total)

    return advance
