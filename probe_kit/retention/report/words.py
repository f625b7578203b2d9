"""The glossary of a page: what the words of its tables mean, and where each is explained."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from probe_kit._tables.table import Table
from probe_kit.retention.columns.glossary import TERMS
from probe_kit.retention.columns.sentences import VERDICT_HELP

_AGAINST = "against: "
"""Before a verdict of the opposite direction."""


@dataclass(frozen=True)
class Word:
    """An entry. anchor: its id in the page."""

    name: str
    meaning: str
    anchor: str


@dataclass(frozen=True)
class Words:
    """entries: by what they stand in.

    headings: the place of a column's word and meaning; two tables may give a word two meanings. values: the place
    of a cell's text that is a word.
    """

    entries: Mapping[str, tuple[Word, ...]]
    headings: Mapping[tuple[str, str], str]
    values: Mapping[str, str]


def words_of(tables: Sequence[Table]) -> Words:
    """The words of all columns of `tables` and of the verdicts in them, and terms that are neither."""
    cells = {cell.value for table in tables for row in table.rows for cell in row.cells}
    groups: dict[str, dict[tuple[str, str], None]] = {}
    for table in tables:
        title = re.split("[:,]", table.title)[0]
        entries_of = {(column.text, column.help): None for column in table.headings if column.help}
        groups.setdefault(title, {}).update({word: None for word in entries_of if word not in _all(groups)})
    words = {_word(cell) for cell in cells}
    groups["Verdicts"] = {(name, text): None for name, text in VERDICT_HELP.items() if name in words}
    groups["Further terms"] = {word: None for word in TERMS.items() if word not in _all(groups)}
    places = {word: f"word-{number}" for number, word in enumerate(_all(groups))}
    entries = {
        title: tuple(Word(*word, places[word]) for word in entries_of)
        for title, entries_of in groups.items()
        if entries_of
    }
    of_values = {
        name: anchor for (name, text), anchor in places.items() if (VERDICT_HELP | TERMS).get(name) == text
    }
    return Words(entries, places, {cell: of_values[_word(cell)] for cell in cells if _word(cell) in of_values})


def _word(cell: str) -> str:
    """A verdict without its direction, side and bound."""
    return cell.removeprefix(_AGAINST).partition(" (")[0]


def _all(groups: Mapping[str, Mapping[tuple[str, str], None]]) -> list[tuple[str, str]]:
    return [word for of_table in groups.values() for word in of_table]
