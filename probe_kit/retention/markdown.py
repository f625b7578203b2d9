"""Retention tables in Markdown."""

from collections.abc import Sequence
from itertools import groupby

from probe_kit.retention.cells import (
    ABOVE_CHANCE,
    CONTROL_COLUMNS,
    DIFFERENCE_COLUMNS,
    FOLLOWED_COLUMNS,
    FURTHER_RETENTION,
    RULE_COLUMNS,
    WORDING_COLUMNS,
    Column,
    action_place,
    beats,
    call_value,
    controlled,
    difference_title,
    first_iteration,
    followed,
    margin_value,
    model_name,
    number,
    once_per_category,
    paper_margin,
    percent,
    prefix_place,
    probed,
    retention_value,
    rule_name,
    success_interval,
    title,
    with_limits,
    wording_title,
)
from probe_kit.retention.conditions import rule_sentences
from probe_kit.retention.differences import Difference
from probe_kit.retention.plain_tables import PlainTable, is_asked
from probe_kit.retention.rows import RetentionRow
from probe_kit.retention.wordings import WordingPair


def _score(row: RetentionRow) -> str:
    return f"normalised score {number(row.normalised_score, 1)}"


SUCCESS_COLUMNS: list[Column] = [
    ("model", model_name),
    ("category", lambda row: row.category),
    ("SR % [95 %]", success_interval),
    ("± Δ %", margin_value),
    ("paper's Δ %", paper_margin),
    ("wrong %", lambda row: percent(row.p_wrong)),
    ("outside %", lambda row: percent(row.p_oob)),
    ("never moved %", lambda row: percent(row.p_never_moved)),
    ("flagged steps %", lambda row: percent(row.p_flagged)),
    ("original / swapped %", lambda row: f"{percent(row.sr_original)} / {percent(row.sr_swapped)}"),
    ("left / right %", lambda row: f"{percent(row.sr_left)} / {percent(row.sr_right)}"),
    ("regime", lambda row: _regime(row)),
    ("n (items)", lambda row: f"{row.n_episodes} ({row.n_items})"),
]

RETENTION_COLUMNS: list[Column] = [
    ("model", model_name),
    ("view", lambda row: row.view or "–"),
    ("call", call_value),
    ("category", lambda row: row.category),
    ("bounded retention [95 %]", retention_value),
    *FURTHER_RETENTION,
    ("backbone % [95 %]", lambda row: with_limits(percent(row.prefix_accuracy), row.prefix_ci, percent)),
    ("at layer", prefix_place),
    ("p", lambda row: number(row.prefix_p_fwe, 3)),
    ("action % [95 %]", lambda row: with_limits(percent(row.action_accuracy), row.action_ci, percent)),
    ("at layer @iteration", action_place),
    ("p", lambda row: number(row.action_p_fwe, 3)),
    ("first iteration %", first_iteration),
    ("gap %", lambda row: percent(row.gap)),
    ("chance %", lambda row: percent(row.chance)),
    ("groups", lambda row: "–" if row.n_groups is None else str(row.n_groups)),
    ("backbone beats", beats),
]


def markdown(
    rows: Sequence[RetentionRow],
    differences: Sequence[Difference] = (),
    notes: Sequence[str] = (),
    wordings: Sequence[WordingPair] = (),
    further: Sequence[PlainTable] = (),
) -> str:
    """Success rates and, where there are any, retention, controls, differences, wordings, more and notes."""
    asked, behaviour = any(is_asked(row) for row in rows), once_per_category(rows)
    columns = [(_of_both(name) if asked else name, cell) for name, cell in SUCCESS_COLUMNS]
    columns[3:3] = FOLLOWED_COLUMNS if followed(rows) else []
    what = "SR / accuracy" if asked else f"Success rate by {rule_name(rows)}"
    parts = [_rows_table(what, behaviour, columns)]
    if any(row.sr_idle is not None for row in rows):
        columns = [*SUCCESS_COLUMNS[:3], *((f"{name} %", cell) for name, cell in RULE_COLUMNS)]
        parts.append(_rows_table(f"What the {rule_name(rows)} makes of it", behaviour, columns))
    parts += [f"> {sentence}\n" for sentence in rule_sentences(behaviour)]
    if probed(rows):
        parts.append(_rows_table("Retention", probed(rows), RETENTION_COLUMNS))
    if controlled(rows):
        columns = [("model", model_name), ("view", lambda row: row.view or "–")]
        columns += [("call", call_value), *CONTROL_COLUMNS]
        parts.append(_rows_table("Controls", probed(rows), columns))
    for heading, of_pair in groupby(differences, key=difference_title):
        cells = [[row.category, *(cell(row) for _, cell in DIFFERENCE_COLUMNS)] for row in of_pair]
        parts.append(_markdown_table(heading, ["category", *(name for name, _ in DIFFERENCE_COLUMNS)], cells))
    for heading, of_run in groupby(wordings, key=wording_title):
        ladder = [[row.category, *(cell(row) for _, cell in WORDING_COLUMNS)] for row in of_run]
        parts.append(_markdown_table(heading, ["category", *(name for name, _ in WORDING_COLUMNS)], ladder))
    parts += [f"{_markdown_table(own.title, own.columns, own.cells)}\n{own.note}\n" for own in further]
    return "\n".join([*parts, *(f"> {note}\n" for note in notes)])


def _of_both(heading: str) -> str:
    """A heading over policies that acted and readers that were asked."""
    return {"SR % [95 %]": "SR / accuracy % [95 %]", "outside %": "outside / unread %"}.get(heading, heading)


def _regime(row: RetentionRow) -> str:
    if row.sr is None:
        return "did not act" if row.listened else "n/a"
    return row.regime or _score(row)


def _rows_table(what: str, rows: Sequence[RetentionRow], columns: Sequence[Column]) -> str:
    cells = [[cell(row) for _, cell in columns] for row in rows]
    return _markdown_table(title(what, rows), [heading for heading, _ in columns], cells)


def _markdown_table(heading: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [
        f"**{heading}**",
        "",
        _markdown_line(columns),
        _markdown_line(["---"] * len(columns)),
        *(_markdown_line([_marked(cell.replace("|", r"\|")) for cell in cells]) for cells in rows),
        "",
    ]
    return "\n".join(lines)


def _marked(cell: str) -> str:
    """Markdown has no colour that renders everywhere: a red sign and bold type."""
    return f"🔴 **{cell}**" if cell.endswith(ABOVE_CHANCE) else cell


def _markdown_line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
