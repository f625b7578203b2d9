"""The option `--format` of commands that print a table, and the table in each of its formats."""

from collections.abc import Sequence
from typing import Annotated, Any

import typer

from probe_kit._tables import formats
from probe_kit._terminal.console import out, print_json_text, print_text, say_note
from probe_kit._terminal.options import choices, one_of

STYLES = ("table", "json", "csv", *formats.names())
Format = Annotated[
    str, typer.Option("--format", parser=one_of(STYLES), metavar=choices(STYLES), help="Format of the result.")
]


def print_table(table: Any, style: str, notes: Sequence[str] = ()) -> None:
    """Print a table, or an object with its methods, on stdout in a format of `STYLES`; `notes` go to stderr."""
    if style == "table":
        out.print(table)
    elif style == "json":
        print_json_text(table.to_json())
    else:
        # Results of interventions have their own JSON and CSV, and no other format.
        written = getattr(table, f"to_{style}", None)
        print_text((table.to_text(style) if written is None else written()).rstrip("\n"))
    for note in notes:
        say_note(note)
