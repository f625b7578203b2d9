"""Plain tables of what a success rate depends on: the outcome rule, and how an item was worded."""

from collections.abc import Sequence
from itertools import groupby

from probe_kit.retention.behaviour.wordings import WordingPair
from probe_kit.retention.columns.text import (
    RULE_COLUMNS,
    WORDING_COLUMNS,
    model_name,
    once_per_category,
    rule_name,
    wording_title,
)
from probe_kit.retention.columns.text_table import TextTable, is_asked
from probe_kit.retention.rows.outcome_rules import rule_sentence
from probe_kit.retention.rows.row import MEAN, RetentionRow


def condition_tables(rows: Sequence[RetentionRow], wordings: Sequence[WordingPair]) -> list[TextTable]:
    """What the outcome rule makes of every model, and the wordings of each run against each other."""
    acted = [row for row in once_per_category(rows) if not is_asked(row)]
    found = []
    if any(row.sr_idle is not None for row in acted):
        columns = ("model", "category", *(f"{name} %" for name, _ in RULE_COLUMNS))
        cells = tuple((model_name(row), row.category, *(cell(row) for _, cell in RULE_COLUMNS)) for row in acted)
        note = "; ".join(rule_sentences(rows))
        found.append(TextTable(f"What the {rule_name(acted)} makes of it", note, columns, cells))
    for title, pairs in groupby(wordings, key=wording_title):
        columns = ("category", *(name for name, _ in WORDING_COLUMNS))
        cells = tuple((pair.category, *(cell(pair) for _, cell in WORDING_COLUMNS)) for pair in pairs)
        found.append(TextTable(title, _LADDER, columns, cells))
    return found


_LADDER = (
    "same items, same seeds; only one: episodes right in the first wording alone, and in the second alone; p: "
    "McNemar, exact; by group: items that share pictures count once; Holm: that, for all pairs of the category"
)


def rule_sentences(rows: Sequence[RetentionRow]) -> list[str]:
    """By which rule each model was judged, and what the rule gives away; every sentence once."""
    return list(dict.fromkeys(rule_sentence(row) for row in rows if row.category == MEAN and not is_asked(row)))
