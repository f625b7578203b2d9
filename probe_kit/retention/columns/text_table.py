"""Tables of text that look the same in every format: sizes of the picture by prompt, VLM − VLA."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

from probe_kit.retention.columns.text import (
    P_DECIDES,
    is_vlm,
    model_name,
    number,
    once_per_category,
    percent,
    success_interval,
    with_limits,
)
from probe_kit.retention.compare.source_weights import Relation
from probe_kit.retention.compare.vlm_vla import VlmVlaDifference
from probe_kit.retention.rows.row import MEAN, RetentionRow


@dataclass(frozen=True)
class TextTable:
    """title and note: what it shows, and what to know when reading it. cells: a row of text per line.

    heads: names over adjoining columns and how many these are, empty names included. names: how many of the first
    columns name the rows. means: whether a row that is called `mean` is one.
    """

    title: str
    note: str
    columns: tuple[str, ...]
    cells: tuple[tuple[str, ...], ...]
    heads: tuple[tuple[str, int], ...] = ()
    names: int = 1
    means: bool = True


def size_table(means: Sequence[RetentionRow]) -> TextTable | None:
    """Mean accuracy by model and prompt, a column per size of the picture; None unless something varies."""
    asked = [row for row in once_per_category(means) if is_vlm(row) and row.category == MEAN]
    sizes = sorted(
        {str(row.answers.picture_size) for row in asked}, key=lambda size: [int(n) for n in size.split("x")]
    )
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for row in asked:
        name = f"{row.run.model} (random weights)" if row.run.random_weights else row.run.model
        extras = [
            str(part) for part in (row.answers.picture, row.answers.asked_for) if part not in ("frame", "target")
        ]
        prompt = " · ".join([str(row.answers.prompt), *extras])
        # Two runs of one model, prompt and size, such as two checkpoints, stand in lines of their own.
        while str(row.answers.picture_size) in lines.get((name, prompt), {}):
            name = model_name(row) if name != model_name(row) else f"{name} '"
        lines.setdefault((name, prompt), {})[str(row.answers.picture_size)] = success_interval(row)
    if len(asked) < 2:
        return None
    return TextTable(
        "Accuracy by prompt and size of the picture",
        "mean over categories in %, with its 95 % interval",
        ("model", "prompt", *sizes),
        tuple((*name, *(found.get(size, "–") for size in sizes)) for name, found in lines.items()),
        names=2,
    )


_GAPS: Sequence[tuple[str, Callable[[VlmVlaDifference], str]]] = [
    ("category", lambda gap: gap.category),
    ("VLM %", lambda gap: percent(gap.accuracy)),
    ("VLA %", lambda gap: percent(gap.sr)),
    ("VLM − VLA [95 %]", lambda gap: with_limits(percent(gap.difference), gap.difference_ci, percent)),
    ("p", lambda gap: number(gap.p, 4)),
    ("p (Holm)", lambda gap: number(gap.p_holm, 4)),
    ("items", lambda gap: _items(gap)),
]


def _items(gap: VlmVlaDifference) -> str:
    """How many are compared, and of how many where some are left out."""
    all_in_common = gap.of_items is None or gap.of_items == gap.n_items
    return str(gap.n_items) if all_in_common else f"{gap.n_items} of {gap.of_items}"


_SOURCES: Mapping[Relation, str] = {
    "yes": "the policy grew from these weights",
    "no": "the policy did NOT grow from these weights",
    "unknown": "unknown whether the policy grew from these weights",
}


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
        f"{items}; {seen}; {_SOURCES[rows[0].source]}; p: exact, whole groups of items flipped; (Holm): over the "
        f"categories of all pairs shown, means by themselves; {P_DECIDES}",
        tuple(name for name, _ in _GAPS),
        tuple(tuple(cell(row) for _, cell in _GAPS) for row in rows),
    )
