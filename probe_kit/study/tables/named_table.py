"""A named table: text for people, and every number of it for programs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from probe_kit._tables.table import Table
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
        """How many tests the table prints."""
        return sum(
            number.get("p") is not None or number.get("p_over_models") is not None for number in self.numbers
        )


def caption(table: RetentionTable, sentences: Sequence[str]) -> str:
    """What a table is of: sentences, the outcome rule, the captured inference, and episodes per category."""
    acted = any(row.run.mode == "acts" and row.success.sr is not None for row in table.rows)
    calls = sorted({row.run.call for row in table.rows if row.run.call is not None})
    counts = sorted({row.success.n_episodes for row in table.rows})
    found = [*sentences]
    found += [f"outcome rule {table.rule}"] if acted else []
    found += [f"captured inference {', '.join(map(str, calls))}"] if calls and calls != [0] else []
    if counts:
        found.append(f"{counts[0] if len(counts) == 1 else f'{counts[0]} to {counts[-1]}'} episodes per category")
    return "; ".join(found)


def titles(categories: Sequence[str]) -> tuple[str, ...]:
    """Titles of categories."""
    return tuple(category_of(name).title for name in categories)


def ordered(categories: Sequence[str]) -> tuple[str, ...]:
    """Categories in the order of the paper, each once."""
    return in_order(categories)
