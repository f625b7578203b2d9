"""Consoles, progress bars and comma-separated lists, shared by the commands.

All output of commands passes through this module, because much of it is foreign text: names in suites and
checkpoints, paths, messages of libraries. What a terminal would obey (escape sequences, marks that turn the
direction of text around) becomes a visible sign. Square brackets are never read as styles.
"""

import json
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from errno import EPIPE
from pathlib import Path
from typing import Any

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.text import Text

from probe_kit._system.escaping import UNSAFE, terminal_safe
from probe_kit._system.json_text import json_text
from probe_kit._system.line_breaks import keep_numbers_whole

for _stream in ("stdout", "stderr"):
    if getattr(sys, _stream) is None:  # closed by the caller (`>&-`): its number must not go to the next file
        setattr(sys, _stream, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - open until the end
_NOT_ASCII = re.compile(r"[^\x00-\x7f]")
PAGE = 120
"""The columns of a table that is written to a file or a pipe, where no terminal says how many there are."""


_HELD = "\ufdd0"
"""A blank at which no line is broken, while rich wraps; Unicode has no character of this number."""


class WholeNumbersConsole(Console):
    """A console that breaks no line between a number and its unit. What it writes has plain blanks there."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Draw; texts are wrapped where `keep_numbers_whole` leaves blanks."""
        if isinstance(renderable, str):
            renderable = self.render_str(renderable)
        if isinstance(renderable, Text):
            held = keep_numbers_whole(renderable.plain, _HELD)
            if held != renderable.plain:
                renderable = renderable.copy()
                renderable.plain = held
        for segment in super().render(renderable, options):
            yield segment._replace(text=segment.text.replace(_HELD, " ")) if _HELD in segment.text else segment


class SafeConsole(WholeNumbersConsole):
    """A console on which text is text: it reads no markup, and writes no escape sequence but its own."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def on_broken_pipe(self) -> None:
        """Raise BrokenPipeError, with which typer ends the command quietly: a reader such as `head` has enough."""
        raise BrokenPipeError(EPIPE, "the reader has gone")

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Draw with visible signs in place of what the terminal would obey."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=terminal_safe(segment.text))


def markup(template: str, *values: object) -> Text:
    """Fill a template of rich's markup, which has a `{}` for each value; a value is shown as text only."""
    text = Text.from_markup(template, emoji=False)
    parts = text.split("{}", allow_blank=True, include_separator=True)
    filled = iter(values)
    for part in parts:
        if part.plain.endswith("{}"):
            _fill(part, str(next(filled)))
    return Text().join(parts)


def _fill(part: Text, value: str) -> None:
    """Put `value` in the place of the `{}` that ends `part`, in its style."""
    last = len(part) - 1
    styles = [span.style for span in part.spans if span.start <= last < span.end]
    part.right_crop(2)
    start = len(part)
    part.append(value)
    for style in styles:
        part.stylize(style, start)


out = SafeConsole(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else PAGE)
"""The console of results: what a script would read."""
err = SafeConsole(stderr=True)
"""The console of progress, plans and notes."""


@contextmanager
def whole_numbers_in_help() -> Iterator[None]:
    """Wrap help that typer prints in the body as all other text; typer takes its console from no caller."""
    from typer import rich_utils

    names = vars(rich_utils)
    former, names["Console"] = names["Console"], WholeNumbersConsole
    try:
        yield
    finally:
        names["Console"] = former


def split(text: str | None) -> tuple[str, ...] | None:
    """Return the parts of a comma-separated option, each once; None stays None."""
    return None if text is None else tuple(dict.fromkeys(filter(None, map(str.strip, text.split(",")))))


def whole_number(text: str) -> int | None:
    """Return the number of a text of up to nine digits, None for any other."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else None


def print_json(value: Any) -> None:
    """Print `value` as JSON on stdout; a number that is not finite, which JSON lacks, as null."""
    print_json_text(json_text(value))


def print_json_text(text: str) -> None:
    """Print JSON on stdout.

    Characters that a terminal would obey, or that stdout's encoding lacks, are written as JSON's own escapes, so
    nothing is lost.
    """
    safe = UNSAFE.sub(_json_escape, text)
    try:
        safe.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        safe = _NOT_ASCII.sub(_json_escape, safe)
    typer.echo(safe)


def _json_escape(match: re.Match[str]) -> str:
    """Return a sign as JSON writes it in ASCII: one escape, or the two of a surrogate pair."""
    return json.dumps(match[0])[1:-1] if ord(match[0]) != 0x7F else "\\u007f"


def print_text(text: str) -> None:
    """Print text of a format of its own, such as CSV, on stdout."""
    typer.echo(terminal_safe(text))


def say(renderable: RenderableType) -> None:
    """Print progress or a note on stderr, however wide."""
    err.print(renderable, soft_wrap=True)


def say_note(text: str) -> None:
    """Print on stderr a note that a reader of a result has to know."""
    say(markup("[yellow]note:[/] {}", text))


def complain(kind: str, message: str, notes: Iterable[str] = ()) -> None:
    """Print an error on stderr: its name, its message, and the notes that belong to it."""
    say(markup("[bold red]{}[/]: {}", kind, message))
    for note in notes:
        say(f"  {note}")


@contextmanager
def progress() -> Iterator[Progress]:
    """Yield the progress on stderr: bars in a terminal; elsewhere `counter` prints a line now and then."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err, disable=not err.is_terminal) as bar:
        yield bar


def counter(bar: Progress, description: str) -> Callable[..., None]:
    """Return a callback (done, total, …) that moves one bar of `bar`, or prints lines if there is no terminal."""
    if not err.is_terminal:
        return Heartbeat(description, say)
    task = bar.add_task(description, total=None)

    def advance(finished: int, total: int, *_: object) -> None:
        bar.update(task, completed=finished, total=total)

    return advance


# -- lines in place of bars -----------------------------------------------------------------------------------

FIRST = 10.0
"""The seconds until the first line."""
EVERY = 60.0
"""The seconds between two lines."""


class Heartbeat:
    """A progress callback (finished, total, …): a line after `FIRST` seconds, every `EVERY`, and at the end.

    The rate counts what was done since the first call: before it a model was loaded, or a run that is continued
    was made.

    Args:
        what: The things that are counted, at the beginning of a line.
        say: A function that takes each line.
        clock: A function that returns seconds since any origin.
    """

    def __init__(
        self, what: str, say: Callable[[str], object], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._what = what
        self._say = say
        self._clock = clock
        self._started = clock()
        self._first: tuple[int, float] | None = None
        self._due = self._started + FIRST
        self._ended: tuple[int, int] | None = None

    def __call__(self, finished: int, total: int, *_: object) -> None:
        """Note that `finished` of `total` are done, and write a line if one is due; other arguments are unused."""
        now = self._clock()
        if self._first is None:
            self._first = finished, now
        # Several events of one answer, as a worker of a Ray cluster gives them, all find the last one counted.
        if (finished, total) == self._ended or (now < self._due and finished < total):
            return
        self._ended = (finished, total) if finished >= total else None
        self._due = now + EVERY
        before, since = self._first
        rate = (finished - before) / (now - since) if now > since else 0.0
        pace = f", {_per_time(rate)}" if rate > 0 else ""
        remaining = f", about {duration((total - finished) / rate)} left" if rate > 0 and finished < total else ""
        self._say(f"{self._what}: {finished}/{total} after {duration(now - self._started)}{pace}{remaining}")


def duration(seconds: float) -> str:
    """Return a duration in its two largest units: `3 h 12 min`, `4 min 05 s`, `12 s`."""
    minutes, seconds_left = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {seconds_left:02d} s" if minutes else f"{seconds_left} s"


def _per_time(rate: float) -> str:
    """Return a `rate` per second in the unit in which it is at least one: per second, minute or hour."""
    for seconds, unit in ((1, "s"), (60, "min")):
        if rate * seconds >= 1:
            return f"{rate * seconds:.1f} per {unit}"
    return f"{rate * 3600:.1f} per h"
