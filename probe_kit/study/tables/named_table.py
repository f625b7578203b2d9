"""A named table: text for people, and every number of it for programs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from probe_kit.retention.columns.text_table import TextTable
from probe_kit.suite.categories import category_of, in_order

Number = Mapping[str, Any]


@dataclass(frozen=True)
class NamedTable:
    """text: what is printed. numbers: one object per number, with system, category, interval and n."""

    text: TextTable
    numbers: tuple[Number, ...]

    def with_note(self, sentences: Sequence[str]) -> "NamedTable":
        """The same with more sentences below it."""
        note = "; ".join([self.text.note, *sentences])
        return replace(self, text=replace(self.text, note=note))


def titles(categories: Sequence[str]) -> tuple[str, ...]:
    """Titles of categories."""
    return tuple(category_of(name).title for name in categories)


def ordered(categories: Sequence[str]) -> tuple[str, ...]:
    """Categories in the order of the paper, each once."""
    return in_order(categories)
