"""What an image swap did, as a table for a terminal."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit.intervene.kinds.base import TableContext
from probe_kit.intervene.kinds.image_swap.effects import SMALLEST_EFFECT_OF_INTEREST, ImageSwapEffect
from probe_kit.intervene.kinds.image_swap.verdict import (
    SMALLEST_SHARE_OF_INTEREST,
    UseVerdict,
    describe_readouts,
)

if TYPE_CHECKING:
    from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable

_LEGEND = (
    "moved: displacement toward the correct picture in units of the policy's own reach, "
    f"{SMALLEST_SHARE_OF_INTEREST} of which count; follow: goes to the correct picture, and to the other side "
    "once the two are swapped; reversal: the reverse; "
    f"net: follow − reversal, {SMALLEST_EFFECT_OF_INTEREST} of which count; p: exact, by item and by group, the "
    "larger one"
)
_REACH = {
    "actions": "reach: {:.1f} cm between the actions that go left and those that go right",
    "tiles": "reach: {:.1f} cm, the distance between the tiles, since too few actions go to one of the sides",
}


def image_swap_table(rows: Sequence[ImageSwapEffect], context: TableContext) -> "ResponsiveTable":
    """One line per category, with its verdict."""
    from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable

    verdicts = context.verdicts
    reasons = dict.fromkeys(f"{name}: {one.explanation}" for name, one in verdicts.items() if one.explanation)
    reaches = dict.fromkeys(_REACH[row.reach_source].format(100 * row.reach) for row in rows)
    shown = (verdicts.get(row.category) for row in rows)
    readouts = describe_readouts(use for use in shown if isinstance(use, UseVerdict))
    said = [verdicts[row.category].verdict if row.category in verdicts else "–" for row in rows]
    return ResponsiveTable(
        title=f"Is it used? {context.subject}, images swapped",
        caption="; ".join(filter(None, [_LEGEND, readouts, *reaches, *(reasons if context.explains else ())])),
        name="category",
        names=tuple(row.category for row in rows),
        styles=("",) * len(rows),
        parts=(
            Part("Verdict", ("verdict",), tuple((Cell(verdict),) for verdict in said)),
            swap_part("Does the action follow the images?", rows),
        ),
    )


def swap_part(title: str, rows: Sequence[ImageSwapEffect]) -> "Part":
    """The columns that all swaps have."""
    from probe_kit._terminal.responsive_table import Part

    columns = (
        "moved [95 %]", "follow %", "reversal %", "net [95 %]", "p", "median displacement cm", "n (items)",
    )  # fmt: skip
    return Part(title, columns, tuple(_cells(row) for row in rows))


def _cells(row: ImageSwapEffect) -> "tuple[Cell, ...]":
    from probe_kit._terminal.responsive_table import Cell

    (low, high), (least, most) = row.net_follow_rate_ci, row.reach_share_ci
    texts = (
        f"{row.reach_share:+.2f} [{least:+.2f}, {most:+.2f}]",
        f"{100 * row.follow_rate:.1f}",
        f"{100 * row.reversal_rate:.1f}",
        f"{row.net_follow_rate:+.2f} [{low:+.2f}, {high:+.2f}]",
        f"{row.follow_p:.2g}",
        f"{100 * row.median_displacement:.2f}",
        f"{row.n_episodes} ({row.n_items})",
    )
    return tuple(map(Cell, texts))
