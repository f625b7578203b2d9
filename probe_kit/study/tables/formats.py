"""Named tables as plain values for JSON."""

from dataclasses import asdict
from typing import Any

from probe_kit.retention.columns.text_table import TextTable
from probe_kit.study.tables.named_table import NamedTable


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
