"""Named tables in Markdown, as comma-separated values, and as plain values for JSON."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from probe_kit._system.csv_text import csv_of_rows
from probe_kit._system.markdown_text import markdown_safe
from probe_kit.retention.columns.text_table import TextTable
from probe_kit.retention.formats.markdown import markdown_table
from probe_kit.study.tables.named_table import NamedTable


def markdown_text(made: NamedTable) -> str:
    """The table in Markdown, with its note below."""
    return f"{markdown_table(made.text)}\n{markdown_safe(made.text.note)}."


def table_record(made: NamedTable) -> dict[str, Any]:
    """All of a table as plain values, from which `table_of_record` makes it again."""
    return {"text": asdict(made.text), "numbers": list(made.numbers)}


def table_of_record(record: dict[str, Any]) -> NamedTable:
    """The table of a record. Raises KeyError or TypeError for what is none."""
    text = record["text"]
    cells = tuple(tuple(row) for row in text["cells"])
    heads = tuple((name, count) for name, count in text["heads"])
    shown = TextTable(text["title"], text["note"], tuple(text["columns"]), cells, heads, text.get("names", 1))
    return NamedTable(shown, tuple(record["numbers"]))


def table_json(made: NamedTable) -> dict[str, Any]:
    """Title, note, and one object per number."""
    return {"table": made.text.title, "note": made.text.note, "numbers": list(made.numbers)}


def table_csv(made: NamedTable) -> str:
    """One row per number; an interval is two columns, `…_low` and `…_high`, empty where there is none."""
    intervals = {name for number in made.numbers for name, value in number.items() if _is_interval(value)}
    rows = [dict(_cells(number, intervals)) for number in made.numbers]
    return csv_of_rows(list(dict.fromkeys(name for row in rows for name in row)), rows)


def _is_interval(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and not any(isinstance(end, str) for end in value)


def _cells(number: Mapping[str, Any], intervals: set[str]) -> Iterator[tuple[str, Any]]:
    for name, value in number.items():
        if name in intervals:
            low, high = value or (None, None)
            yield from ((f"{name}_low", low), (f"{name}_high", high))
        else:
            yield name, value
