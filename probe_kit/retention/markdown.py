"""Retention tables in Markdown."""

from collections.abc import Sequence

from probe_kit.retention.cells import (
    Column,
    debiased_value,
    model_name,
    number,
    once_per_category,
    peak,
    percent,
    probed,
    retention_value,
    success_interval,
    title,
)
from probe_kit.retention.rows import RetentionRow

SUCCESS_COLUMNS: list[Column] = [
    ("model", model_name),
    ("category", lambda row: row.category),
    ("SR % [95 %]", success_interval),
    ("Δ %", lambda row: percent(row.delta)),
    ("wrong %", lambda row: percent(row.p_wrong)),
    ("outside %", lambda row: percent(row.p_oob)),
    ("original / swapped %", lambda row: f"{percent(row.sr_original)} / {percent(row.sr_swapped)}"),
    ("left / right %", lambda row: f"{percent(row.sr_left)} / {percent(row.sr_right)}"),
    ("regime", lambda row: row.regime or f"normalised score {number(row.normalised_score, 1)}"),
    ("n (items)", lambda row: f"{row.n_episodes} ({row.n_items})"),
]

RETENTION_COLUMNS: list[Column] = [
    ("model", model_name),
    ("view", lambda row: row.view or "–"),
    ("category", lambda row: row.category),
    ("prefix %", lambda row: percent(row.prefix_accuracy)),
    ("at depth", lambda row: peak(row.prefix_depth)),
    ("p", lambda row: number(row.prefix_p_fwe, 3)),
    ("action %", lambda row: percent(row.action_accuracy)),
    ("at depth @step", lambda row: peak(row.action_depth, row.action_iteration)),
    ("retention", retention_value),
    ("debiased [95 %]", debiased_value),
    ("gap %", lambda row: percent(row.gap)),
    ("chance %", lambda row: percent(row.chance)),
    ("groups", lambda row: "–" if row.n_groups is None else str(row.n_groups)),
]


def markdown(rows: Sequence[RetentionRow]) -> str:
    """Success rates and, where there are probes, retention."""
    parts = [_markdown_table("Success rate", once_per_category(rows), SUCCESS_COLUMNS)]
    if probed(rows):
        parts.append(_markdown_table("Retention", probed(rows), RETENTION_COLUMNS))
    return "\n".join(parts)


def _markdown_table(what: str, rows: Sequence[RetentionRow], columns: Sequence[Column]) -> str:
    lines = [
        f"**{title(what, rows)}**",
        "",
        _markdown_line([heading for heading, _ in columns]),
        _markdown_line(["---"] * len(columns)),
        *(_markdown_line([cell(row).replace("|", r"\|") for _, cell in columns]) for row in rows),
        "",
    ]
    return "\n".join(lines)


def _markdown_line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
