"""What closed loops did, as a table for a console."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit.intervene.kinds.base import TableContext, by_category, count_edits
from probe_kit.intervene.kinds.closed_loop.effects import MIN_IN_ZONE_RATIO, ClosedLoopEffect
from probe_kit.intervene.kinds.image_swap.effects import SMALLEST_EFFECT_OF_INTEREST
from probe_kit.intervene.store.answers import CLEAN
from probe_kit.suite.categories import category_of

if TYPE_CHECKING:
    from probe_kit._terminal.responsive_table import Cell, ResponsiveTable

_LEGEND = (
    "every episode played again, same scene and seeds, with the edit at every inference; in a zone: whichever "
    "picture; net flip rate: share of episodes that end on the wrong picture, minus that with the identity patch; "
    "p: family-wise, of what goes beyond the controls, one-sided; confirmed: p < 0.05 and "
    f"{SMALLEST_EFFECT_OF_INTEREST} beyond the controls; task disrupted: in a zone less than "
    f"{MIN_IN_ZONE_RATIO:g} times as often as with the identity patch, and then in no verdict"
)


def closed_loop_table(rows: Sequence[ClosedLoopEffect], context: TableContext) -> "ResponsiveTable":
    """One line per category and condition, the identity patch first."""
    from probe_kit._terminal.responsive_table import Part, ResponsiveTable

    return ResponsiveTable(
        title=f"Is it so in closed loop? {context.subject}",
        caption=_LEGEND,
        name="category · edit",
        names=tuple(f"{row.category} · {'identity patch' if row.place == CLEAN else row.name}" for row in rows),
        styles=tuple("bold" if row.finding == "confirmed" else "" for row in rows),
        parts=(
            Part(
                "Where the cube ends",
                ("correct %", "wrong %", "in a zone %", "wrong of these %"),
                tuple(_ends(row) for row in rows),
            ),
            Part(
                "Compared with the identity patch",
                ("net flip rate [95 %]", "left / right", "controls", "only with : only without", "p", "finding"),
                tuple(_against(row) for row in rows),
            ),
        ),
    )


def closed_loop_sentences(rows: Sequence[ClosedLoopEffect], _: TableContext) -> list[str]:
    """One per category: at which places the cube turns to the other picture."""
    return [f"{category_of(name).title}: {_finding(own)}." for name, own in by_category(rows).items()]


def _finding(rows: Sequence[ClosedLoopEffect]) -> str:
    edits = [row for row in rows if row.place != CLEAN]
    found = [f"{row.name} {row.net:+.2f}" for row in edits if row.finding == "confirmed"]
    disrupted = [row.name for row in edits if row.finding == "task disrupted"]
    turned = (
        f"edits that turn the cube to the other picture beyond their controls: {count_edits(found, len(edits))}"
    )
    return turned + (f"; that disrupt the task: {count_edits(disrupted, len(edits))}" if disrupted else "")


def _ends(row: ClosedLoopEffect) -> "tuple[Cell, ...]":
    from probe_kit._terminal.responsive_table import Cell

    shares = (row.correct, row.wrong, row.in_zone, row.wrong_in_zone)
    return tuple(Cell("–" if share is None else f"{100 * share:.1f}") for share in shares)


def _against(row: ClosedLoopEffect) -> "tuple[Cell, ...]":
    from probe_kit._terminal.responsive_table import Cell

    if row.place == CLEAN:
        return (*(Cell("–") for _ in range(5)), Cell(row.finding))
    low, high = row.net_ci
    texts = (
        f"{row.net:+.2f} [{low:+.2f}, {high:+.2f}]", f"{_signed(row.net_left)} / {_signed(row.net_right)}",
        _signed(row.control_net), f"{row.gained} : {row.lost}", "–" if row.p_fwe is None else f"{row.p_fwe:.2g}",
        row.finding,
    )  # fmt: skip
    return tuple(map(Cell, texts))


def _signed(value: float | None) -> str:
    return "–" if value is None else f"{value:+.2f}"
