"""What closed loops did, as a table for a console."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit.intervene.kinds.closed_loop.effects import MIN_IN_ZONE_RATIO, ClosedLoopEffect
from probe_kit.intervene.kinds.image_swap.effects import SMALLEST_EFFECT_OF_INTEREST
from probe_kit.intervene.store.answers import CLEAN

if TYPE_CHECKING:
    from probe_kit._terminal.responsive_table import Cell, ResponsiveTable

_LEGEND = (
    "every episode played again, same scene and seeds, with the change at every inference; in a zone: whichever "
    "picture; turned: share of episodes that end on the wrong picture, minus that at dose 0; p: family-wise, of "
    f"what goes beyond the controls, one-sided; confirmed: p < 0.05 and {SMALLEST_EFFECT_OF_INTEREST} beyond the controls; hand broken: "
    f"in a zone less than {MIN_IN_ZONE_RATIO:g} times as often as at dose 0, and then in no verdict"
)


def carried_out_table(rows: Sequence[ClosedLoopEffect], of: str) -> "ResponsiveTable":
    """One line per category and condition, dose 0 first. of: which model, on which suite."""
    from probe_kit._terminal.responsive_table import Part, ResponsiveTable

    return ResponsiveTable(
        title=f"Is it so when carried out? {of}",
        caption=_LEGEND,
        name="category · change",
        names=tuple(f"{row.category} · {'dose 0' if row.place == CLEAN else row.name}" for row in rows),
        styles=tuple("bold" if row.finding == "confirmed" else "" for row in rows),
        parts=(
            Part(
                "Where the cube ends",
                ("correct %", "wrong %", "in a zone %", "wrong of these %"),
                tuple(_ends(row) for row in rows),
            ),
            Part(
                "Against dose 0",
                ("turned [95 %]", "left / right", "controls", "only with : only without", "p", "finding"),
                tuple(_against(row) for row in rows),
            ),
        ),
    )


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
