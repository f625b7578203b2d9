"""Named tables as plain values for JSON."""

from typing import Any

from probe_kit._tables.table import Cell, Heading, Row
from probe_kit.study.tables.named_table import NamedTable


def table_record(made: NamedTable) -> dict[str, Any]:
    """All of a table as plain values, from which `table_of_record` makes it again."""
    return {
        "title": made.title,
        "notes": list(made.notes),
        "names": made.names,
        "headings": [[heading.group, heading.text] for heading in made.headings],
        "rows": [
            {"cells": cells, "is_mean": row.is_mean} for cells, row in zip(made.texts, made.rows, strict=True)
        ],
        "numbers": list(made.numbers),
    }


def table_of_record(record: dict[str, Any]) -> NamedTable:
    """The table of a record. Raises KeyError, TypeError or ValueError for what is none."""
    return NamedTable(
        title=str(record["title"]),
        headings=tuple(Heading(str(text), group=str(group)) for group, text in record["headings"]),
        rows=tuple(Row(tuple(map(Cell, map(str, row["cells"]))), bool(row["is_mean"])) for row in record["rows"]),
        names=int(record["names"]),
        notes=tuple(map(str, record["notes"])),
        numbers=tuple(record["numbers"]),
    )


def table_json(made: NamedTable) -> dict[str, Any]:
    """Title, note, and one object per number."""
    return {"table": made.title, "note": "; ".join(made.notes), "numbers": list(made.numbers)}
