"""Effects of interventions as tables for a console."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from probe_kit.intervene.following import WORTH, Following
from probe_kit.intervene.verdict import Judgement

if TYPE_CHECKING:
    from probe_kit.fitting_tables import Cell, FittingTable

_LEGEND = (
    "follows: goes to the correct picture, and to the other side once the two are exchanged; against: the "
    f"reverse; net: follows − against, {WORTH} of which count; p: exact, one-sided, by item"
)


def following_table(
    rows: Sequence[Following], verdicts: Mapping[str, Judgement], label: str, suite: str, random_weights: bool
) -> "FittingTable":
    """One line per category."""
    from probe_kit.fitting_tables import Cell, FittingTable, Part

    marked = f"{label} (random weights)" if random_weights else label
    reasons = dict.fromkeys(f"{name}: {one.reason}" for name, one in verdicts.items() if one.reason)
    return FittingTable(
        title=f"Is it used? {marked} on {suite}, pictures exchanged",
        caption="; ".join([_LEGEND, *reasons]),
        name="category",
        names=tuple(row.category for row in rows),
        styles=("",) * len(rows),
        parts=(
            Part(
                "Does the action follow the pictures?",
                ("follows %", "against %", "net [95 %]", "p", "median shift cm", "n (items)"),
                tuple(_cells(row) for row in rows),
            ),
            Part(
                "Verdict",
                ("verdict",),
                tuple(
                    (Cell(verdicts[row.category].verdict if row.category in verdicts else "–"),) for row in rows
                ),
            ),
        ),
    )


def _cells(row: Following) -> "tuple[Cell, ...]":
    from probe_kit.fitting_tables import Cell

    low, high = row.net_ci
    texts = (
        f"{100 * row.follows:.1f}", f"{100 * row.against:.1f}", f"{row.net:+.2f} [{low:+.2f}, {high:+.2f}]",
        f"{row.p_follows:.2g}", f"{100 * row.shift:.2f}", f"{row.n_episodes} ({row.n_items})",
    )  # fmt: skip
    return tuple(map(Cell, texts))
