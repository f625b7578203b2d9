"""Retention tables on a console: one block per run, whole at any width."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from probe_kit._terminal.responsive_table import Cell, FittingTable, Part
from probe_kit.retention.behaviour.success_rate import Regime
from probe_kit.retention.behaviour.wordings import WordingPair
from probe_kit.retention.columns.conditions import condition_tables, rule_sentences
from probe_kit.retention.columns.lines import (
    TableRow,
    behaviour_lines,
    cell_of,
    compared,
    difference_legend,
    probe_lines,
)
from probe_kit.retention.columns.text import (
    ABOVE_CHANCE,
    ANSWER_LEGEND,
    ANSWER_MEASURES,
    ANSWER_SCORES,
    CONTROL_PARTS,
    DIFFERENCE_TEST,
    FOLLOWED_COLUMNS,
    FURTHER_RETENTION,
    RULE_COLUMNS,
    Column,
    action_place,
    action_value,
    backbone_place,
    backbone_value,
    beats,
    bounded_value,
    call_words,
    controlled,
    first_iteration,
    margin_value,
    model_name,
    number,
    once_per_category,
    paper_margin,
    percent,
    probed,
    success_interval,
)
from probe_kit.retention.columns.text_table import TextTable, is_asked
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.rows.row import MEAN, RetentionRow
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
    further: Sequence[TextTable] = (),
    unpaired: Sequence[str] = (),
) -> "Group":
    """Success rates of all runs in one table, retention and controls in one per view; wordings, more and notes.

    Several runs go by letters, under each other, with their differences below them. VLM runs stand above a rule.
    further: tables behind these. unpaired: why runs have no differences.
    """
    from rich.console import Group
    from rich.rule import Rule
    from rich.text import Text

    called = _letters(rows)
    tables: list[FittingTable | Rule | Text] = []
    for kind, of_kind in groupby(rows, key=lambda row: row.kind):
        if tables and kind != "asks":
            tables.append(Rule("asked above, acting below", style="dim"))
        tables += _of_kind(list(of_kind), differences, called)
    tables += [Text(sentence, style="yellow") for sentence in unpaired]
    conditions = condition_tables([], wordings)  # outcome rules are columns of their own here
    plain = map(_plain, [*conditions, *further])
    return Group(*tables, *plain, *(Text(note, style="yellow") for note in notes))


def _of_kind(
    rows: Sequence[RetentionRow], differences: Sequence[Difference], called: "_Letters"
) -> "list[FittingTable]":
    """Of asked, or of policy runs."""
    once = once_per_category(rows)
    lines = behaviour_lines(once, differences)
    if is_asked(rows[0]):
        what, parts, notes = "Accuracy of answers", _ANSWERS, [_ANSWER_LEGEND, ANSWER_LEGEND]
    else:
        what, parts, notes = "Success rate", _SUCCESS, [_OUTCOME_LEGEND, *rule_sentences(once)]
    tables = [_of_runs(what, lines, parts, notes, called)]
    for view in dict.fromkeys(row.view for row in probed(rows)):
        shown = [row for row in rows if row.view == view]
        reasons = dict.fromkeys(row.retention_note for row in shown if row.retention_note)
        legend = [_SITE_LEGEND, *reasons, *_judged(shown)]
        tables.append(
            _of_runs(f"Retention, view {view}", probe_lines(shown, differences), _RETENTION, legend, called)
        )
        if controlled(shown):
            legend = [_control_legend(shown)]
            tables.append(_of_runs(f"Controls, view {view}", compared(shown), _CONTROLS, legend, called))
    return tables


def _plain(table: TextTable) -> FittingTable:
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
    found = [row.backbone_exceeds for row in rows if row.backbone_exceeds]
    tried = any(better is not None for beats in found for name, better in beats.items() if name != "chance")
    mark = "signal is judged against chance only: add the controls binding and untrained"
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

_ANSWER_LEGEND = "wrong, unread (no answer, or several): each in % of all"

_ANSWERS: dict[str, Sequence[Column]] = {
    "Does it know the answer?": [
        ("accuracy % [95 %]", success_interval),
        DIFFERENCE_TEST,
        ("± Δ", margin_value),
        ("regime", _regime),
        ("left / right", _sides),
    ],
    "How it answered": [
        ("wrong", lambda row: percent(row.share_wrong)),
        ("unread", lambda row: percent(row.share_outside)),
        *(column for column in ANSWER_SCORES if column[0] != "unreadable"),  # that is: unread
        *ANSWER_MEASURES,
    ],
}
_SUCCESS: dict[str, Sequence[Column]] = {
    "Does it act on the answer?": [
        ("SR % [95 %]", success_interval),
        DIFFERENCE_TEST,
        ("± Δ", margin_value),
        ("paper's Δ", paper_margin),
        ("regime", _regime),
        ("left / right", _sides),
        *FOLLOWED_COLUMNS,
    ],
    "Where the cube ended": [
        ("wrong", lambda row: percent(row.share_wrong)),
        ("outside", lambda row: percent(row.share_outside)),
        ("never moved", lambda row: percent(row.share_never_moved)),
    ],
    "What the outcome rule makes of it": RULE_COLUMNS,
}
_RETENTION: dict[str, Sequence[Column]] = {
    "In the backbone": [
        ("backbone % [95 %]", backbone_value),
        ("layer", backbone_place),
        ("p", lambda row: number(row.backbone_p_fwe, 3)),
        ("beats", beats),
    ],
    "Where the action is made": [
        ("action % [95 %]", action_value),
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


_Letters = Mapping[tuple[str | None, str], str]
"""By group and run, what it is called in a table of several."""


def _letters(rows: Sequence[RetentionRow]) -> _Letters:
    runs = dict.fromkeys((row.group, row.run) for row in rows)
    return {run: _letter(at) for at, run in enumerate(runs)}


def _letter(at: int) -> str:
    """A to Z, then A2 to Z2."""
    round_, place = divmod(at, 26)
    return chr(ord("A") + place) + (str(round_ + 1) if round_ else "")


def _of_runs(
    what: str,
    lines: Sequence[TableRow],
    parts: Mapping[str, Sequence[Column]],
    notes: Sequence[str],
    called: _Letters,
) -> FittingTable:
    """One run by its name, several by their letters."""
    rows = [line for line in lines if isinstance(line, RetentionRow)]
    runs = {(row.group, row.run): row for row in reversed(rows)}
    suites = ", ".join(dict.fromkeys(row.suite for row in rows))
    if len(called) == 1:
        name, names = "category", [row.category for row in rows]
        title, sizes = f"{what}: {model_name(rows[0])} on {suites}", f"{_folder(rows)}, {_sizes(rows)}"
    else:
        shown = [key for key in called if key in runs]
        title = f"{what}: {', '.join(f'{called[key]} {model_name(runs[key])}' for key in shown)} on {suites}"
        name, names = "category · run", [f"{line.category} {_short(line, rows, called)}" for line in lines]
        sizes = _sizes_of({called[key]: [r for r in rows if (r.group, r.run) == key] for key in shown})
    tested = any(DIFFERENCE_TEST in columns for columns in parts.values())
    legend = difference_legend([line for line in lines if isinstance(line, Difference)], tested)
    return _fitting(title, "; ".join(filter(None, [sizes, *notes, legend])), name, names, lines, parts)


def _short(line: TableRow, rows: Sequence[RetentionRow], called: _Letters) -> str:
    """A run's letter, or those of two; a group of several runs by its name."""
    if isinstance(line, RetentionRow):
        return called[line.group, line.run]
    letters: dict[str, list[str]] = {}
    for row in rows:
        letters.setdefault(model_name(row) if row.group is None else row.group, []).append(
            called[row.group, row.run]
        )
    sides = ["".join(dict.fromkeys(letters[side])) for side in (line.group, line.minus)]
    return " − ".join(sides) + ("" if line.paired else ", other items")


def _fitting(
    title: str,
    caption: str,
    name: str,
    names: Sequence[str],
    lines: Sequence[TableRow],
    parts: Mapping[str, Sequence[Column]],
) -> FittingTable:
    """Columns in which no line has anything to show are left out."""
    found = []
    for question, columns in parts.items():
        shown = [column for column in columns if any(cell_of(column[1], line) not in ("–", "") for line in lines)]
        cells = tuple(tuple(_coloured(cell_of(cell, line)) for _, cell in shown) for line in lines)
        if shown:
            found.append(Part(question, tuple(heading for heading, _ in shown), cells))
    return FittingTable(
        title=title,
        caption=caption,
        name=name,
        names=tuple(names),
        styles=tuple(_style(line) for line in lines),
        parts=tuple(found),
    )


def _style(line: TableRow) -> str:
    return " ".join(["bold"] * (line.category == MEAN) + ["italic"] * isinstance(line, Difference))


def _coloured(cell: str) -> Cell:
    return Cell(cell, "bold red" if cell.endswith(ABOVE_CHANCE) else "")


def _control_legend(rows: Sequence[RetentionRow]) -> str:
    untrained = f"; untrained: {rows[0].untrained}" if rows[0].untrained else ""
    fewest = min(row.n_items for row in rows if row.category != MEAN)
    seen = f"with {fewest} items a leak of {percent(detectable(fewest))} % is found in 4 of 5 suites"
    return f"held-out accuracy % without the model, {seen}; selectivity: accuracy above random labels{untrained}"


def _sizes_of(runs: Mapping[str, Sequence[RetentionRow]]) -> str:
    """Of several runs by their letters; what is the same of all is said once."""
    found = {letter: _sizes(rows) for letter, rows in runs.items()}
    if len(set(found.values())) == 1:
        return "; ".join([*(f"{letter}: {_folder(rows)}" for letter, rows in runs.items()), *set(found.values())])
    return "; ".join(f"{letter}: {_folder(runs[letter])}, {sizes}" for letter, sizes in found.items())


def _folder(rows: Sequence[RetentionRow]) -> str:
    return f"run {Path(rows[0].run).name}"


def _sizes(rows: Sequence[RetentionRow]) -> str:
    """What is the same, or nearly so, in all rows."""
    single = [row for row in rows if row.category != MEAN]
    parts = [
        f"per category {_span([row.n_episodes for row in single])} episodes",
        f"{_span([row.n_items for row in single])} items",
    ]
    if groups := [row.n_groups for row in single if row.n_groups is not None]:
        parts.append(f"{_span(groups)} groups")
    flags = [percent(row.share_invalid_action) for row in single if row.share_invalid_action is not None]
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
