"""Attention shares, as a table for a terminal."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit.intervene.edits.sites import TILE_ROLES
from probe_kit.intervene.kinds.attention.attention_mass import CORRECT, OTHER, AttentionRow, AttentionShares
from probe_kit.intervene.kinds.base import TableContext

if TYPE_CHECKING:
    from probe_kit._terminal.responsive_table import ResponsiveTable

_LEGEND = (
    "Descriptive, in no verdict: attended tokens need not be used. Percent of the acting stream's attention, "
    "means over heads, iterations and inferences: all: on the backbone's tokens, action: on its own; image.left, "
    "image.right: on patches that see a tile; correct − other: on the correct picture's tile less the other's, by "
    "groups of items. By iteration and head: --format csv"
)


def attention_table(_: Sequence[AttentionRow], context: TableContext) -> "ResponsiveTable":
    """One line per category and block of the backbone that is read."""
    from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable

    attention = AttentionShares.of(context.measurement)
    names, shares, sides = [], [], []
    rows = attention.rows(("block",))
    roles = [role for role in dict.fromkeys(row.role for row in rows) if role not in (CORRECT, OTHER)]
    for category, own in attention.by_category():
        apart = own.correct_minus_other(context.measurement.seed_text)
        blocks = dict.fromkeys(row.block for row in rows if row.category == category)
        for block in blocks:
            found = {row.role: row.share for row in rows if (row.category, row.block) == (category, block)}
            names.append(f"{category} · block {block:02d}")
            shares.append(tuple(Cell(f"{100 * found[role]:.1f}" if role in found else "–") for role in roles))
            if block in apart:
                value, (low, high) = apart[block]
                sides.append((Cell(f"{100 * value:+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]"),))
            else:
                sides.append((Cell("–"),))
    parts = [Part("Where the attention lies, %", tuple(roles), tuple(shares))]
    if set(TILE_ROLES) <= set(roles):
        parts.append(Part("Tiles by answer", ("correct − other [95 %]",), tuple(sides)))
    return ResponsiveTable(
        title=f"What does it attend to? {context.subject}, attention",
        caption=_LEGEND,
        name="category · read",
        names=tuple(names),
        styles=("",) * len(names),
        parts=tuple(parts),
    )
