"""A screen by gradients, as a table and sentences for a terminal."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit.intervene.kinds.attribution.effects import AGREEMENT, AttributionEffect, worst_anchor
from probe_kit.intervene.kinds.base import TableContext
from probe_kit.suite.categories import category_of

if TYPE_CHECKING:
    from probe_kit._terminal.responsive_table import Cell, ResponsiveTable

_LEGEND = (
    "estimate: share of the image swap by gradients; exact: with these tokens patched; anchor: a complete cut, "
    f"patched exactly; a screen that misses an anchor by more than a factor of {AGREEMENT:.0f} is void and shows "
    "no order; drawn: chosen at random from the rest; p: of the exact patch, max-T over those of the "
    "category; a screen enters no verdict"
)
NAMED = 3
"""Cells that a sentence names."""


def attribution_table(rows: Sequence[AttributionEffect], context: TableContext) -> "ResponsiveTable":
    """One line per category and cell."""
    from probe_kit._terminal.responsive_table import Part, ResponsiveTable

    void = [f"{own[0].category}: {_void(own)}" for own in _by_category(rows).values() if own[0].finding == "void"]
    return ResponsiveTable(
        title="; ".join([f"Which places to patch? {context.subject}, gradients", *dict.fromkeys(void)]),
        caption=_LEGEND,
        name="category · cell",
        names=tuple(f"{row.category} · {row.name}" for row in rows),
        styles=tuple("bold" if row.is_anchor else "" for row in rows),
        parts=(
            Part(
                "Share of the image swap",
                ("rank", "estimate [95 %]", "exact [95 %]", "p", "chosen"),
                tuple(_cells(row) for row in rows),
            ),
        ),
    )


def attribution_sentences(rows: Sequence[AttributionEffect], _: TableContext) -> list[str]:
    """One per category: whether the screen holds, and what it puts first."""
    return [f"{category_of(name).title}: {describe_screen(own)}." for name, own in _by_category(rows).items()]


def _by_category(rows: Sequence[AttributionEffect]) -> dict[str, list[AttributionEffect]]:
    found: dict[str, list[AttributionEffect]] = {}
    for row in rows:
        found.setdefault(row.category, []).append(row)
    return found


def describe_screen(rows: Sequence[AttributionEffect]) -> str:
    """Of one category: what the anchors show, and the first cells of each kind unless the screen is void."""
    worst = worst_anchor(rows)
    if worst is None:
        return "no anchor carries the effect, so that there is no order"
    if worst.finding == "void":
        return f"{_void(rows)}; no order is shown"
    firsts = [
        _first([row for row in rows if row.kind == kind]) for kind in dict.fromkeys(row.kind for row in rows)
    ]
    drawn = [abs(row.exact) for row in rows if row.is_drawn and row.exact is not None]
    missed = [f"of {len(drawn)} drawn cells the largest exact effect is {max(drawn):.2f}"] if drawn else []
    return "; ".join([_compared(worst), *filter(None, firsts), *missed])


def _first(rows: Sequence[AttributionEffect]) -> str:
    """The largest estimates of one kind; empty for the anchors, which have no rank."""
    named = [_named(row) for row in rows if row.rank is not None and row.rank <= NAMED]
    return f"first of {rows[0].kind}: {', '.join(named)}" if named else ""


def _void(rows: Sequence[AttributionEffect]) -> str:
    worst = worst_anchor(rows)
    assert worst is not None
    return f"screen void: {_compared(worst)}"


def _compared(anchor: AttributionEffect) -> str:
    return f"gradients give {_two(anchor.estimate)} where the patch gives {_two(anchor.exact)} ({anchor.name})"


def _named(row: AttributionEffect) -> str:
    exact = "" if row.exact is None else f", exact {_two(row.exact)}"
    return f"{row.name} {_two(row.estimate)}{exact}"


def _cells(row: AttributionEffect) -> "tuple[Cell, ...]":
    from probe_kit._terminal.responsive_table import Cell

    chosen = "anchor" if row.is_anchor else "drawn" if row.is_drawn else "top" if row.p_fwe is not None else ""
    texts = (
        "–" if row.rank is None else str(row.rank), _share(row.estimate, row.estimate_ci),
        _share(row.exact, row.exact_ci), "–" if row.p_fwe is None else f"{row.p_fwe:.2g}", chosen,
    )  # fmt: skip
    return tuple(map(Cell, texts))


def _share(value: float | None, limits: tuple[float, float] | None) -> str:
    if value is None or limits is None:
        return "–"
    return f"{_two(value)} [{_two(limits[0])}, {_two(limits[1])}]"


def _two(value: float | None) -> str:
    """Two digits, and zero without a sign."""
    return "–" if value is None else f"{round(value, 2) + 0.0:.2f}"
