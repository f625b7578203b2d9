"""What a success rate depends on: tables of wordings, and sentences about outcome rules."""

from collections.abc import Callable, Sequence
from itertools import groupby

from probe_kit.retention.behaviour.wordings import WordingPair
from probe_kit.retention.columns.text import is_vlm, number, percent
from probe_kit.retention.columns.text_table import TextTable
from probe_kit.retention.rows.outcome_rules import rule_sentence
from probe_kit.retention.rows.row import MEAN, RetentionRow

_COLUMNS: Sequence[tuple[str, Callable[[WordingPair], str]]] = [
    ("category", lambda row: row.category),
    ("wordings", lambda row: f"{row.wording} / {row.other}"),
    ("n", lambda row: str(row.n_episodes)),
    ("SR %", lambda row: f"{percent(row.sr)} / {percent(row.other_sr)}"),
    ("only one", lambda row: f"{row.only} / {row.only_other}"),
    ("p", lambda row: number(row.p, 3)),
    ("p by group", lambda row: number(row.p_groups, 3)),
    ("Holm", lambda row: number(row.p_holm, 3)),
]
_LADDER = (
    "same items, same seeds; only one: episodes right in the first wording alone, and in the second alone; p: "
    "McNemar, exact; by group: items that share pictures count once; Holm: that, over all categories, pairs and "
    "runs shown"
)


def wording_tables(wordings: Sequence[WordingPair]) -> list[TextTable]:
    """The wordings of each run against each other."""
    return [
        TextTable(
            title,
            _LADDER,
            tuple(name for name, _ in _COLUMNS),
            tuple(tuple(cell(pair) for _, cell in _COLUMNS) for pair in pairs),
        )
        for title, pairs in groupby(wordings, key=lambda pair: f"Wordings, {pair.label}")
    ]


def rule_sentences(rows: Sequence[RetentionRow]) -> list[str]:
    """By which rule each model was judged, and what the rule gives away; every sentence once."""
    found = [rule_sentence(row.rules) for row in rows if row.category == MEAN and not is_vlm(row)]
    return list(dict.fromkeys(found))
