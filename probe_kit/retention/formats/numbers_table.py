"""A table for people with the numbers behind it, in every format."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from probe_kit._system.csv_text import csv_of_rows
from probe_kit._system.markdown_text import markdown_safe
from probe_kit.retention.columns.text_table import TextTable

if TYPE_CHECKING:
    from probe_kit._terminal.responsive_table import ResponsiveTable


@dataclass(frozen=True)
class NumbersTable:
    """A table of text and its numbers.

    text: the table that people read. numbers: one object per row, shares in [0, 1]; None where a number is
    unknown.
    """

    text: TextTable
    numbers: tuple[Mapping[str, Any], ...]

    def to_json(self) -> str:
        """Return the numbers as a JSON list of objects."""
        return json.dumps(self.numbers, indent=1, ensure_ascii=False)

    def to_csv(self) -> str:
        """Return the numbers as comma-separated values with a header.

        An interval is two columns, `…_low` and `…_high`, empty where there is none.
        """
        intervals = {name for number in self.numbers for name, value in number.items() if _is_interval(value)}
        rows = [dict(_cells(number, intervals)) for number in self.numbers]
        return csv_of_rows(list(dict.fromkeys(name for row in rows for name in row)), rows)

    def to_markdown(self) -> str:
        """Return the table in Markdown, with its note below."""
        from probe_kit.retention.formats.markdown import markdown_table

        return f"{markdown_table(self.text)}\n{markdown_safe(self.text.note)}."

    def to_latex(self) -> str:
        """Return the table as a LaTeX `table` environment."""
        from probe_kit.retention.formats.latex import latex_table

        return latex_table(self.text)

    def to_rich(self) -> "ResponsiveTable":
        """Return the table for a rich console."""
        from probe_kit.retention.formats.terminal import responsive_table

        return responsive_table(self.text)


def _is_interval(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and not any(isinstance(end, str) for end in value)


def _cells(number: Mapping[str, Any], intervals: set[str]) -> Iterator[tuple[str, Any]]:
    for name, value in number.items():
        if name in intervals:
            low, high = value or (None, None)
            yield from ((f"{name}_low", low), (f"{name}_high", high))
        else:
            yield name, value
