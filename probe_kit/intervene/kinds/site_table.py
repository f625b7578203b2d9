"""Effects of edits of sites as a table for a terminal."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit.intervene.kinds.base import TableContext, by_category, count_edits
from probe_kit.intervene.kinds.reach import SMALLEST_REACH
from probe_kit.intervene.kinds.site_effects import PatchEffect
from probe_kit.suite.categories import category_of

if TYPE_CHECKING:
    from probe_kit._terminal.responsive_table import Cell, ResponsiveTable

_LEGEND = (
    "effect: share of what the whole image swap does, n/a where that is not beyond chance; net flip rate: share "
    "of episodes that flip to the target side, minus those that flip away from it; p: family-wise over all edits "
    "of the category, one-sided; relative change: how far tokens were moved, in their own norms; *: carries the "
    "effect by construction and locates nothing; unread: nothing that acts reads this place"
)


def site_table(rows: Sequence[PatchEffect], context: TableContext) -> "ResponsiveTable":
    """One line per category and edit; controls are columns of what is compared with them."""
    from probe_kit._terminal.responsive_table import Part, ResponsiveTable

    shown = [row for row in rows if not row.is_control]
    unread = context.measurement.certificate.get("unread", ())
    return ResponsiveTable(
        title=f"Where is it used? {context.subject}, {context.measurement.settings['kind']}",
        caption=_LEGEND,
        name="category · edit",
        names=tuple(f"{row.category} · {row.name}{' (unread)' * (row.place in unread)}" for row in shown),
        styles=tuple("bold" if row.is_localised and not row.is_by_construction else "" for row in shown),
        parts=(
            Part(
                "What the action does",
                (
                    "effect",
                    "net flip rate [95 %]",
                    "left / right",
                    "displacement cm",
                    "controls cm",
                    "p",
                    "relative change",
                ),
                tuple(_cells(row) for row in shown),
            ),
        ),
    )


def site_sentences(rows: Sequence[PatchEffect], _: TableContext) -> list[str]:
    """One per category: which edits carry half of what the image swap does, or move the action at all."""
    return [f"{category_of(name).title}: {_finding(own)}." for name, own in by_category(rows).items()]


def _finding(rows: Sequence[PatchEffect]) -> str:
    edits = [row for row in rows if row.coefficient != "0"]
    if all(row.effect is None for row in edits):
        moved = sorted((row for row in edits if row.moves_action), key=lambda row: -row.mean_displacement)
        named = [f"{row.name} {100 * row.mean_displacement:+.1f} cm" for row in moved]
        return (
            f"edits that move the action at least {100 * SMALLEST_REACH:g} cm to the target side, beyond their "
            f"controls: {count_edits(named, len(edits))}"
        )
    found = sorted((row for row in edits if row.is_localised), key=lambda row: -(row.effect or 0.0))
    named = [f"{row.name} {row.effect:.2f}" for row in found]
    verb = "have" if any(row.is_dose for row in edits) else "carry"
    return f"edits that {verb} half of the image swap's effect: {count_edits(named, len(edits))}"


def _cells(row: PatchEffect) -> "tuple[Cell, ...]":
    from probe_kit._terminal.responsive_table import Cell

    low, high = row.net_ci
    texts = (
        "n/a" if row.effect is None else f"{row.effect:.2f}{'*' * (row.is_localised and row.is_by_construction)}",
        f"{row.net:+.2f} [{low:+.2f}, {high:+.2f}]",
        f"{row.net_left:+.2f} / {row.net_right:+.2f}",
        f"{100 * row.mean_displacement:+.2f}",
        "–" if row.control_displacement is None else f"{100 * row.control_displacement:+.2f}",
        "–" if row.p_fwe is None else f"{row.p_fwe:.2g}",
        f"{row.relative_change:.2f}",
    )
    return tuple(map(Cell, texts))
