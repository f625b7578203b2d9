"""Retention tables in Markdown."""

from collections.abc import Sequence

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
    CONTROL_COLUMNS,
    DIFFERENCE_TEST,
    FOLLOWED_COLUMNS,
    FURTHER_RETENTION,
    Column,
    action_place,
    action_value,
    backbone_place,
    backbone_value,
    beats,
    call_value,
    category_name,
    controlled,
    first_iteration,
    followed,
    margin_value,
    model_name,
    number,
    once_per_category,
    paper_margin,
    percent,
    probed,
    retention_value,
    rule_name,
    success_interval,
    title,
    view_name,
)
from probe_kit.retention.columns.text_table import TextTable, is_asked
from probe_kit.retention.compare.differences import Difference
from probe_kit.retention.rows.row import RetentionRow


def _score(row: RetentionRow) -> str:
    return f"normalised score {number(row.normalised_score, 1)}"


SUCCESS_COLUMNS: list[Column] = [
    ("model", model_name),
    ("category", category_name),
    ("SR % [95 %]", success_interval),
    ("± Δ %", margin_value),
    ("paper's Δ %", paper_margin),
    ("wrong %", lambda row: percent(row.share_wrong)),
    ("outside %", lambda row: percent(row.share_outside)),
    ("never moved %", lambda row: percent(row.share_never_moved)),
    ("flagged steps %", lambda row: percent(row.share_invalid_action)),
    ("original / swapped %", lambda row: f"{percent(row.sr_original)} / {percent(row.sr_swapped)}"),
    ("left / right %", lambda row: f"{percent(row.sr_left)} / {percent(row.sr_right)}"),
    ("regime", lambda row: _regime(row)),
    ("n (items)", lambda row: f"{row.n_episodes} ({row.n_items})"),
]

RETENTION_COLUMNS: list[Column] = [
    ("model", model_name),
    ("view", view_name),
    ("call", call_value),
    ("category", category_name),
    ("bounded retention [95 %]", retention_value),
    *FURTHER_RETENTION,
    ("backbone % [95 %]", backbone_value),
    ("at layer", backbone_place),
    ("p", lambda row: number(row.backbone_p_fwe, 3)),
    ("action % [95 %]", action_value),
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
    further: Sequence[TextTable] = (),
    unpaired: Sequence[str] = (),
) -> str:
    """Success rates and, where there are any, retention, controls, conditions, more and notes.

    Differences stand below the runs of their category; unpaired: why others have none.
    """
    asked, behaviour = any(is_asked(row) for row in rows), once_per_category(rows)
    more = [DIFFERENCE_TEST] if any(row.p is not None for row in differences) else []
    more += FOLLOWED_COLUMNS if followed(rows) else []
    shown = [*SUCCESS_COLUMNS[:3], *more, *SUCCESS_COLUMNS[3:]]
    columns = [(_of_both(name) if asked else name, cell) for name, cell in shown]
    what = "SR / accuracy" if asked else f"Success rate by {rule_name(rows)}"
    parts = [_lines_table(title(what, behaviour), behaviour_lines(behaviour, differences), columns)]
    captions = [f"{sentence}." for sentence in [difference_legend(differences)] if sentence]
    parts += [f"> {sentence}\n" for sentence in (*captions, *unpaired)]
    conditions = condition_tables(rows, wordings)
    if all(row.sr_idle is None for row in rows):  # else their table says it
        parts += [f"> {sentence}\n" for sentence in rule_sentences(behaviour)]
    if probed(rows):
        lines = probe_lines(probed(rows), differences)
        parts.append(_lines_table(title("Retention", probed(rows)), lines, RETENTION_COLUMNS))
    if controlled(rows):
        columns = [("model", model_name), ("view", view_name)]
        columns += [("call", call_value), *CONTROL_COLUMNS]
        parts.append(_lines_table(title("Controls", probed(rows)), compared(probed(rows)), columns))
    plain = [*conditions, *further]
    parts += [f"{_markdown_table(own.title, own.columns, own.cells)}\n{own.note}\n" for own in plain]
    return "\n".join([*parts, *(f"> {note}\n" for note in notes)])


def _of_both(heading: str) -> str:
    """A heading over policies that acted and readers that were asked."""
    return {"SR % [95 %]": "SR / accuracy % [95 %]", "outside %": "outside / unread %"}.get(heading, heading)


def _regime(row: RetentionRow) -> str:
    if row.sr is None:
        return "did not act" if row.listened else "n/a"
    return row.regime or _score(row)


def _lines_table(heading: str, lines: Sequence[TableRow], columns: Sequence[Column]) -> str:
    cells = [[cell_of(cell, line) for _, cell in columns] for line in lines]
    return _markdown_table(heading, [name for name, _ in columns], cells)


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
