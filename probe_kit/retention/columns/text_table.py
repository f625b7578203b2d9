"""Tables of text that look the same in every format: answers, sizes of the picture by prompt, VLM − VLA."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby

from probe_kit.retention.columns.text import (
    ANSWER_LEGEND,
    ANSWER_MEASURES,
    ANSWER_SCORES,
    Column,
    category_name,
    model_name,
    number,
    once_per_category,
    percent,
    success_interval,
    with_limits,
)
from probe_kit.retention.compare.vlm_vla import VlmVlaDifference
from probe_kit.retention.rows.row import MEAN, RetentionRow

ANSWERS = "Answers"


@dataclass(frozen=True)
class TextTable:
    """title and note: what it shows, and what to know when reading it. cells: a row of text per line."""

    title: str
    note: str
    columns: tuple[str, ...]
    cells: tuple[tuple[str, ...], ...]


def is_asked(row: RetentionRow) -> bool:
    """Whether a row is of a VLM run."""
    return row.kind == "asks"


_ANSWERS: Sequence[Column] = [
    ("model", model_name),
    ("category", category_name),
    ("accuracy % [95 %]", success_interval),
    *((f"{name} %", cell) for name, cell in ANSWER_SCORES),
    *ANSWER_MEASURES,
]


def answer_table(rows: Sequence[RetentionRow]) -> TextTable | None:
    """How VLM runs answered, by every score; None if no run was asked."""
    asked = once_per_category([row for row in rows if is_asked(row)])
    if not asked:
        return None
    scores = ", ".join(dict.fromkeys(str(row.score) for row in asked))
    return TextTable(
        ANSWERS,
        f"accuracy is by {scores}; {ANSWER_LEGEND}",
        tuple(name for name, _ in _ANSWERS),
        tuple(tuple(cell(row) for _, cell in _ANSWERS) for row in asked),
    )


def size_table(means: Sequence[RetentionRow]) -> TextTable | None:
    """Mean accuracy by model and prompt, a column per size of the picture; None unless something varies."""
    asked = [row for row in once_per_category(means) if is_asked(row) and row.category == MEAN]
    sizes = sorted({str(row.picture_size) for row in asked}, key=lambda size: [int(n) for n in size.split("x")])
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for row in asked:
        name = f"{row.model} (random weights)" if row.random_weights else row.model
        extras = [str(part) for part in (row.picture, row.asked_for) if part not in ("frame", "target")]
        prompt = " · ".join([str(row.prompt), *extras])
        # Two runs of one model, prompt and size, such as two checkpoints, stand in lines of their own.
        while str(row.picture_size) in lines.get((name, prompt), {}):
            name = model_name(row) if name != model_name(row) else f"{name} '"
        lines.setdefault((name, prompt), {})[str(row.picture_size)] = success_interval(row)
    if len(asked) < 2:
        return None
    return TextTable(
        "Accuracy by prompt and size of the picture",
        "mean over categories in %, with its 95 % interval",
        ("model", "prompt", *sizes),
        tuple((*name, *(found.get(size, "–") for size in sizes)) for name, found in lines.items()),
    )


_GAPS: Sequence[tuple[str, Callable[[VlmVlaDifference], str]]] = [
    ("category", lambda gap: gap.category),
    ("VLM %", lambda gap: percent(gap.accuracy)),
    ("VLA %", lambda gap: percent(gap.sr)),
    ("VLM − VLA [95 %]", lambda gap: with_limits(percent(gap.difference), gap.difference_ci, percent)),
    ("p", lambda gap: number(gap.p, 4)),
    ("p (Holm)", lambda gap: number(gap.p_holm, 4)),
    ("items", lambda gap: str(gap.n_items)),
]


def vlm_vla_tables(gaps: Sequence[VlmVlaDifference]) -> list[TextTable]:
    """One table per pair of a VLM run and a policy run."""
    return [
        _gap_table(asked, acted, list(rows))
        for (asked, acted), rows in groupby(gaps, key=lambda gap: (gap.asked, gap.acted))
    ]


def _gap_table(asked: str, acted: str, rows: Sequence[VlmVlaDifference]) -> TextTable:
    frames = {row.same_frames for row in rows}
    seen = (
        "the same first frames" if frames == {True} else "OTHER first frames" if False in frames else "no hashes"
    )
    items = "the same items" if all(row.paired for row in rows) else "OTHER items: not paired, no p"
    return TextTable(
        f"VLM − VLA: {asked} − {acted}",
        f"{items}; {seen}; p: exact, whole groups of items flipped",
        tuple(name for name, _ in _GAPS),
        tuple(tuple(cell(row) for _, cell in _GAPS) for row in rows),
    )
