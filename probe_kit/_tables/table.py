"""The table that every command prints: text for people, the numbers behind it, and a method per format."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from probe_kit._system.escaping import csv_of_rows
from probe_kit._system.json_text import json_text
from probe_kit._tables.content import (
    Cell,
    Cells,
    Content,
    FixedText,
    Heading,
    Legend,
    TableRow,
    absent,
    group_headings,
)
from probe_kit._tables.formats import render

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Console, ConsoleOptions, RenderResult

__all__ = ["Cell", "Cells", "FixedText", "Heading", "Legend", "Table", "TableRow", "absent", "group_headings"]


@dataclass(frozen=True)
class Table(Content):
    """A table with its formats; see `Content` for its fields. A rich console and a notebook print it as it is."""

    def __rich_console__(self, console: "Console", options: "ConsoleOptions") -> "RenderResult":
        from probe_kit._tables.terminal import lines

        yield from lines(self, options.max_width)

    def _repr_html_(self) -> str:
        from probe_kit._tables.html import html

        return html(self)

    def to_text(self, style: str) -> str:
        """Return the table in a format of `probe_kit._tables.formats`, its notes below it."""
        return render(style, [self])

    def to_markdown(self) -> str:
        """Return the table in Markdown."""
        return self.to_text("markdown")

    def to_latex(self) -> str:
        """Return the table as a LaTeX `table` environment, behind the packages that it needs."""
        return self.to_text("latex")

    def to_frame(self) -> "pd.DataFrame":
        """Return the text as a data frame."""
        import pandas as pd

        return pd.DataFrame(self.texts, columns=self.columns)

    def to_json(self) -> str:
        """Return the numbers as a JSON list of objects; null for one that is not finite."""
        return json_text(self.numbers, indent=1)

    def to_csv(self) -> str:
        """Return the numbers as comma-separated values with a header.

        An interval is two columns, `…_low` and `…_high`, empty where there is none.
        """
        intervals = {name for number in self.numbers for name, value in number.items() if _is_interval(value)}
        rows = [dict(_flat(number, intervals)) for number in self.numbers]
        return csv_of_rows(list(dict.fromkeys(name for row in rows for name in row)), rows)


def _is_interval(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and not any(isinstance(end, str) for end in value)


def _flat(number: Mapping[str, Any], intervals: set[str]) -> Iterator[tuple[str, Any]]:
    for name, value in number.items():
        if name in intervals:
            low, high = value or (None, None)
            yield from ((f"{name}_low", low), (f"{name}_high", high))
        else:
            # A cell of CSV that is a table itself has no other form than JSON's.
            yield name, json_text(value, None) if isinstance(value, Mapping | list) else value
