"""What erasing did, as a table for a console."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit.intervene.kinds.base import TableContext, by_category, count_edits
from probe_kit.intervene.kinds.erase.effects import ErasureEffect
from probe_kit.suite.categories import category_of

if TYPE_CHECKING:
    from probe_kit._terminal.responsive_table import Cell, ResponsiveTable

_LEGEND = (
    "goes there: share of episodes whose action goes to the correct picture; kept: of how far, n/a where it does "
    "not; controls: the mean of random subspaces of the same rank; p: exact, that the action moves away farther "
    "than under the controls, by item and by group, the larger one; probe accuracy: a fresh probe on the mean "
    "over tokens; relative change: how far tokens were moved, in their own norms. Weaker evidence than interchange"
)


def erasure_table(rows: Sequence[ErasureEffect], context: TableContext) -> "ResponsiveTable":
    """One line per category and place; controls are columns of what is compared with them."""
    from probe_kit._terminal.responsive_table import Part, ResponsiveTable

    shown = [row for row in rows if row.finding not in ("control", "identity patch")]
    return ResponsiveTable(
        title=f"What is lost without it? {context.subject}, erase",
        caption=_LEGEND,
        name="category · erased",
        names=tuple(f"{row.category} · {row.name}" for row in shown),
        styles=tuple("bold" if row.finding == "effect" else "" for row in shown),
        parts=(
            Part(
                "What the action does",
                ("goes there %", "controls %", "kept", "controls", "displacement cm", "p", "relative change"),
                tuple(_action_cells(row) for row in shown),
            ),
            Part(
                "What a probe reads",
                ("probe accuracy %", "finding"),
                tuple(_probe_cells(row) for row in shown),
            ),
        ),
    )


def erasure_sentences(rows: Sequence[ErasureEffect], _: TableContext) -> list[str]:
    """One per category: which erasures take the answer from the action."""
    return [f"{category_of(name).title}: {_finding(own)}." for name, own in by_category(rows).items()]


def _finding(rows: Sequence[ErasureEffect]) -> str:
    tried = [row for row in rows if row.finding != "identity patch"]
    if tried and all(row.finding == "no baseline effect" for row in tried):
        return "the unedited action does not go to the correct picture, so that nothing can be lost"
    found = [f"{row.name} keeps {row.kept:.2f}" for row in tried if row.finding == "effect"]
    return f"erasures that take the answer from the action beyond their controls: {count_edits(found, len(tried))}"


def _action_cells(row: ErasureEffect) -> "tuple[Cell, ...]":
    from probe_kit._terminal.responsive_table import Cell

    beside = None if row.control_net is None else row.right_before - row.control_net
    texts = (
        f"{100 * row.right_before:.1f} → {100 * row.right:.1f}", "–" if beside is None else f"{100 * beside:.1f}",
        "n/a" if row.kept is None else f"{row.kept:.2f}",
        "–" if row.control_kept is None else f"{row.control_kept:.2f}",
        f"{-100 * row.mean_displacement:+.2f}", "–" if row.p is None else f"{row.p:.2g}",
        f"{row.relative_change:.2f}",
    )  # fmt: skip
    return tuple(map(Cell, texts))


def _probe_cells(row: ErasureEffect) -> "tuple[Cell, ...]":
    from probe_kit._terminal.responsive_table import Cell

    unknown = row.probe_accuracy_before is None or row.probe_accuracy is None
    read = (
        "–" if unknown else f"{100 * (row.probe_accuracy_before or 0):.1f} → {100 * (row.probe_accuracy or 0):.1f}"
    )
    return Cell(read), Cell(row.finding)
