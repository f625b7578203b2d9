"""A named table: text for people, every number of it for programs, and its record as JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from probe_kit._tables.table import Cell, Heading, Row, Table
from probe_kit.retention.table import RetentionTable
from probe_kit.suite.categories import category_of, in_order

Number = Mapping[str, Any]


@dataclass(frozen=True)
class NamedTable(Table):
    """A table of a study. numbers: one object per number, with system, category, interval and n.

    is_partial: whether runs are missing that `study run` would play; the note names them.
    """

    is_partial: bool = False

    def with_note(self, sentences: Sequence[str]) -> "NamedTable":
        """The same with more sentences below it."""
        return replace(self, notes=(*self.notes, *sentences))

    @property
    def n_tests(self) -> int:
        """The number of tests that the table prints."""
        return sum(
            number.get("p") is not None or number.get("p_over_models") is not None for number in self.numbers
        )


def caption(table: RetentionTable, sentences: Sequence[str]) -> str:
    """Return a caption: sentences, the outcome rule, the captured inference, and episodes per category."""
    acted = any(row.run.mode == "acts" and row.success.sr is not None for row in table.rows)
    calls = sorted({row.run.call for row in table.rows if row.run.call is not None})
    counts = sorted({row.success.n_episodes for row in table.rows})
    parts = [*sentences]
    parts += [f"outcome rule {table.rule}"] if acted else []
    parts += [f"captured inference {', '.join(map(str, calls))}"] if calls and calls != [0] else []
    if counts:
        parts.append(f"{counts[0] if len(counts) == 1 else f'{counts[0]} to {counts[-1]}'} episodes per category")
    return "; ".join(parts)


def titles(categories: Sequence[str]) -> tuple[str, ...]:
    """Titles of categories."""
    return tuple(category_of(name).title for name in categories)


def ordered(categories: Sequence[str]) -> tuple[str, ...]:
    """Categories in the order of the paper, each once."""
    return in_order(categories)


# -- as plain values ----------------------------------------------------------------------------------------------


def table_record(table: NamedTable) -> dict[str, Any]:
    """All of a table as plain values, from which `table_of_record` makes it again."""
    return {
        "title": table.title,
        "notes": list(table.notes),
        "names": table.names,
        "headings": [[heading.group, heading.text] for heading in table.headings],
        "rows": [
            {"cells": cells, "is_mean": row.is_mean} for cells, row in zip(table.texts, table.rows, strict=True)
        ],
        "numbers": list(table.numbers),
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


def table_json(table: NamedTable) -> dict[str, Any]:
    """Title, note, and one object per number."""
    return {"table": table.title, "note": "; ".join(table.notes), "numbers": list(table.numbers)}
