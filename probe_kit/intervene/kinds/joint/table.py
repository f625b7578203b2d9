"""What sets of cells carry, as a table for a terminal."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit.intervene.kinds.base import Measurement, TableContext
from probe_kit.intervene.kinds.joint.effects import (
    EVERY,
    MINIMAL,
    SECOND,
    JointEffect,
    describe_joint_places,
    describe_remainder,
)
from probe_kit.statistics.sign_flips import smallest_flip_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.suite.categories import category_of

if TYPE_CHECKING:
    from probe_kit._terminal.responsive_table import Cell, ResponsiveTable

_LEGEND = (
    "alone: share of the image swap with only these cells patched; needed: what all cells lose without them; "
    "read here: both at least 0.5; enough alone: another copy is read as well; needed, not enough: one part of "
    "several; nothing alone: neither, which leaves a part of a set; opposes it: both below -0.1; smallest set: "
    "searched in one half of the groups, scored in the other; p: that the action moves toward the target side, of "
    "cells max-T over all"
)
_OPEN = "where the answer is read remains open"
_PARTS = {EVERY: "all cells of", MINIMAL: "smallest set:", SECOND: "without it:"}


def joint_table(rows: Sequence[JointEffect], context: TableContext) -> "ResponsiveTable":
    """One line per category and set."""
    from probe_kit._terminal.responsive_table import Part, ResponsiveTable

    return ResponsiveTable(
        title=f"Where is it read, alone and jointly? {context.subject}, joint places",
        caption=_LEGEND,
        name="category · cells",
        names=tuple(
            " ".join(filter(None, (f"{row.category} ·", _PARTS.get(row.part, ""), row.cells))) for row in rows
        ),
        styles=tuple("bold" if row.finding.startswith("read") else "" for row in rows),
        parts=(
            Part(
                "Share of the image swap",
                ("alone [95 %]", "needed [95 %]", "p", "groups", "finding"),
                tuple(_cells(row) for row in rows),
            ),
        ),
    )


def joint_sentences(rows: Sequence[JointEffect], _: TableContext) -> list[str]:
    """One per category: which cells carry the answer, alone or together."""
    found: dict[str, list[JointEffect]] = {}
    for row in rows:
        found.setdefault(row.category, []).append(row)
    return [
        f"{category_of(name).title}: {'; '.join(filter(None, (describe_joint_places(own) or _OPEN, rest)))}."
        for name, own in found.items()
        for rest in (describe_remainder(own),)
    ]


def few_groups_notes(rows: Sequence[JointEffect], _: Measurement) -> list[str]:
    """Where the half of the groups that scores a smallest set cannot confirm any."""
    too_few = {row.category: row.n_groups for row in rows if row.part == MINIMAL and _cannot_confirm(row.n_groups)}
    return [
        f"{name}: the smallest set is scored in {count} groups, in which no p can be below "
        f"{smallest_flip_p(count):.2g}, so that none is confirmed. Play more (--items)."
        for name, count in too_few.items()
    ]


def _cannot_confirm(groups: int) -> bool:
    return smallest_flip_p(groups) >= SIGNIFICANCE


def _cells(row: JointEffect) -> "tuple[Cell, ...]":
    from probe_kit._terminal.responsive_table import Cell

    texts = (
        _share(row.alone, row.alone_ci), _share(row.needed, row.needed_ci),
        f"{row.p if row.p_fwe is None else row.p_fwe:.2g}", str(row.n_groups), row.finding,
    )  # fmt: skip
    return tuple(map(Cell, texts))


def _share(value: float | None, limits: tuple[float, float] | None) -> str:
    if value is None or limits is None:
        return "–"
    return f"{value:.2f} [{limits[0]:.2f}, {limits[1]:.2f}]"
