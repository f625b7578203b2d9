"""Retention tables on a console: one block per run, whole at any width."""

from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit.fitting_tables import Cell, FittingTable, Part
from probe_kit.retention.cells import (
    ABOVE_CHANCE,
    CONTROL_PARTS,
    DIFFERENCE_COLUMNS,
    FOLLOWED_COLUMNS,
    FURTHER_RETENTION,
    RULE_COLUMNS,
    WORDING_COLUMNS,
    Column,
    action_place,
    beats,
    bounded_value,
    call_words,
    controlled,
    difference_title,
    first_iteration,
    margin_value,
    model_name,
    number,
    once_per_category,
    paper_margin,
    percent,
    prefix_place,
    probed,
    success_interval,
    with_limits,
    wording_title,
)
from probe_kit.retention.differences import Difference
from probe_kit.retention.plain_tables import PlainTable, is_asked
from probe_kit.retention.rows import MEAN, RetentionRow
from probe_kit.retention.ruled import rule_sentence
from probe_kit.retention.success import Regime
from probe_kit.retention.wordings import WordingPair
from probe_kit.statistics.significance import detectable

if TYPE_CHECKING:
    from rich.console import Group

_REGIMES: dict[str | None, str] = {
    Regime.KNOWLEDGE: "knowledge",
    Regime.NO_RELIABLE_KNOWLEDGE: "not reliable",
    Regime.FAILURE: "failure",
}


def rich_tables(
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference] = (),
    notes: Sequence[str] = (),
    wordings: Sequence[WordingPair] = (),
    further: Sequence[PlainTable] = (),
) -> "Group":
    """Success rates of every run, its retention and controls per view, differences, wordings, notes.

    Asked runs stand above a rule. further: tables behind these.
    """
    from rich.console import Group
    from rich.rule import Rule
    from rich.text import Text

    tables: list[FittingTable | Rule] = []
    kinds: list[str] = []
    for _, of_run in groupby(rows, key=lambda row: (row.group, row.run)):
        found = list(of_run)
        if kinds[-1:] == ["asks"] and not is_asked(found[0]):
            tables.append(Rule("asked above, acting below", style="dim"))
        kinds.append(found[0].kind)
        once = once_per_category(found)
        if is_asked(found[0]):
            tables.append(_of_run("Accuracy of answers", once, _ANSWERS, [_ANSWER_LEGEND]))
        else:
            tables.append(_of_run("Success rate", once, _SUCCESS, [_OUTCOME_LEGEND, rule_sentence(once[-1])]))
        for view, of_view in groupby(probed(found), key=lambda row: row.view):
            shown = list(of_view)
            reasons = dict.fromkeys(row.retention_note for row in shown if row.retention_note)
            legend = [_SITE_LEGEND, *reasons, *_judged(shown)]
            tables.append(_of_run(f"Retention, view {view}", shown, _RETENTION, legend))
            if controlled(shown):
                tables.append(_of_run(f"Controls, view {view}", shown, _CONTROLS, [_control_legend(shown)]))
    for title, of_pair in groupby(differences, key=difference_title):
        tables.append(_fitting(title, "", list(of_pair), {"Difference": DIFFERENCE_COLUMNS}))
    for title, of_ladder in groupby(wordings, key=wording_title):
        tables.append(_fitting(title, _LADDER_LEGEND, list(of_ladder), _LADDER))
    return Group(*tables, *map(_plain, further), *(Text(note, style="yellow") for note in notes))


def _plain(table: PlainTable) -> FittingTable:
    """Its first columns name the rows."""
    fixed = 1 if table.columns[0] == "category" else 2
    return FittingTable(
        title=table.title,
        caption=table.note,
        name=" · ".join(table.columns[:fixed]),
        names=tuple(" · ".join(cells[:fixed]) for cells in table.cells),
        styles=tuple("bold" if MEAN in cells[:fixed] else "" for cells in table.cells),
        parts=(
            Part(
                "",
                table.columns[fixed:],
                tuple(tuple(Cell(cell, "") for cell in cells[fixed:]) for cells in table.cells),
            ),
        ),
    )


def _judged(rows: Sequence[RetentionRow]) -> list[str]:
    """A warning where nothing but chance was beaten, because nothing else was tried."""
    found = [row.prefix_beats for row in rows if row.prefix_beats]
    tried = any(better is not None for beats in found for name, better in beats.items() if name != "chance")
    mark = "signal is judged against chance only: add the controls binding and twin"
    return [mark] if found and not tried else []


def _regime(row: RetentionRow) -> str:
    if row.sr is None:
        return "did not act" if row.listened else "n/a"
    return f"score {number(row.normalised_score, 1)}" if row.regime is None else _REGIMES[row.regime]


def _sides(row: RetentionRow) -> str:
    return f"{percent(row.sr_left, 0)} / {percent(row.sr_right, 0)}"


_OUTCOME_LEGEND = (
    "Δ decides the regime, over as many items as count; wrong, outside, never moved (part of outside): each in % "
    "of all episodes"
)
_SITE_LEGEND = (
    "layer: the first of the best, + as many others that tie; after @ the iteration (flow step or action token), "
    "of which the first sees no action yet; p family-wise"
)

_LADDER_LEGEND = (
    "only one: episodes right in the first wording alone, and in the second alone; p: McNemar, exact; by group: "
    "items that share pictures count once; Holm: that, for all pairs of the category"
)

_LADDER: dict[str, Sequence[tuple[str, Callable[[WordingPair], str]]]] = {
    "Same items, same seeds": WORDING_COLUMNS
}

_ANSWER_LEGEND = "wrong, unread (no answer, or several): each in % of all; without letter bias: options exchanged"

_ANSWERS: dict[str, Sequence[Column]] = {
    "Does it know the answer?": [
        ("accuracy % [95 %]", lambda row: with_limits(percent(row.sr), row.sr_ci, percent)),
        ("± Δ", margin_value),
        ("regime", _regime),
        ("left / right", _sides),
    ],
    "How it answered": [
        ("wrong", lambda row: percent(row.p_wrong)),
        ("unread", lambda row: percent(row.p_oob)),
        ("by text", lambda row: percent(row.accuracy_text)),
        ("by logits", lambda row: percent(row.accuracy_logits)),
        ("without letter bias", lambda row: percent(row.accuracy_debiased)),
        ("letter bias", lambda row: number(row.letter_bias)),
        ("option mass", lambda row: number(row.option_mass)),
        ("near ties", lambda row: percent(row.p_near_tie)),
    ],
}
_SUCCESS: dict[str, Sequence[Column]] = {
    "Does it act on the answer?": [
        ("SR % [95 %]", success_interval),
        ("± Δ", margin_value),
        ("paper's Δ", paper_margin),
        ("regime", _regime),
        ("left / right", _sides),
        *FOLLOWED_COLUMNS,
    ],
    "Where the cube ended": [
        ("wrong", lambda row: percent(row.p_wrong)),
        ("outside", lambda row: percent(row.p_oob)),
        ("never moved", lambda row: percent(row.p_never_moved)),
    ],
    "What the outcome rule makes of it": RULE_COLUMNS,
}
_RETENTION: dict[str, Sequence[Column]] = {
    "In the backbone": [
        ("backbone % [95 %]", lambda row: with_limits(percent(row.prefix_accuracy), row.prefix_ci, percent)),
        ("layer", prefix_place),
        ("p", lambda row: number(row.prefix_p_fwe, 3)),
        ("beats", beats),
    ],
    "Where the action is made": [
        ("action % [95 %]", lambda row: with_limits(percent(row.action_accuracy), row.action_ci, percent)),
        ("layer", action_place),
        ("p", lambda row: number(row.action_p_fwe, 3)),
        ("first iteration %", first_iteration),
    ],
    "What is retained": [
        ("bounded [95 %]", bounded_value),
        *FURTHER_RETENTION,
        ("gap", lambda row: percent(row.gap)),
    ],
}
_CONTROLS: dict[str, Sequence[Column]] = CONTROL_PARTS


def _of_run(
    what: str, rows: Sequence[RetentionRow], parts: dict[str, Sequence[Column]], notes: Sequence[str]
) -> FittingTable:
    title = f"{what}: {model_name(rows[0])} on {rows[0].suite}"
    return _fitting(title, "; ".join([_sizes(rows), *notes]), rows, parts)


def _fitting[Row: (RetentionRow, Difference, WordingPair)](
    title: str,
    caption: str,
    rows: Sequence[Row],
    parts: dict[str, Sequence[tuple[str, Callable[[Row], str]]]],
) -> FittingTable:
    """Columns in which no row has anything to show are left out."""
    found = []
    for question, columns in parts.items():
        shown = [column for column in columns if any(column[1](row) != "–" for row in rows)]
        cells = tuple(tuple(_coloured(cell(row)) for _, cell in shown) for row in rows)
        if shown:
            found.append(Part(question, tuple(heading for heading, _ in shown), cells))
    return FittingTable(
        title=title,
        caption=caption,
        name="category",
        names=tuple(row.category for row in rows),
        styles=tuple("bold" if row.category == MEAN else "" for row in rows),
        parts=tuple(found),
    )


def _coloured(cell: str) -> Cell:
    return Cell(cell, "bold red" if cell.endswith(ABOVE_CHANCE) else "")


def _control_legend(rows: Sequence[RetentionRow]) -> str:
    twin = f"; twin: {rows[0].twin}" if rows[0].twin else ""
    fewest = min(row.n_items for row in rows if row.category != MEAN)
    seen = f"with {fewest} items a leak of {percent(detectable(fewest))} % is found in 4 of 5 suites"
    return f"held-out accuracy % without the model, {seen}; selectivity: accuracy above random labels{twin}"


def _sizes(rows: Sequence[RetentionRow]) -> str:
    """What is the same, or nearly so, in all rows."""
    single = [row for row in rows if row.category != MEAN]
    parts = [
        f"run {Path(rows[0].run).name}",
        f"per category {_span([row.n_episodes for row in single])} episodes",
        f"{_span([row.n_items for row in single])} items",
    ]
    if groups := [row.n_groups for row in single if row.n_groups is not None]:
        parts.append(f"{_span(groups)} groups")
    flags = [percent(row.p_flagged) for row in single if row.p_flagged is not None]
    if flags:
        parts.append(f"no action in {' / '.join(dict.fromkeys(flags))} % of steps (flagged)")
    if calls := sorted({row.call for row in single if row.call is not None}):
        parts.append("; ".join(map(call_words, calls)))
    if chances := {percent(row.chance) for row in single if row.chance is not None}:
        parts.append(f"chance {' or '.join(sorted(chances))} %")
    return ", ".join(parts)


def _span(numbers: Sequence[int]) -> str:
    low, high = min(numbers), max(numbers)
    return str(low) if low == high else f"{low}–{high}"
