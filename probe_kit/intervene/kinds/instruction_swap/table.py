"""What an instruction swap did, as a table for a terminal."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from probe_kit.intervene.kinds.base import TableContext
from probe_kit.intervene.kinds.image_swap.table import swap_part
from probe_kit.intervene.kinds.instruction_swap.effects import InputSensitivity, InstructionSwapEffect

if TYPE_CHECKING:
    from probe_kit._terminal.responsive_table import Cell, ResponsiveTable

_LEGEND = (
    "follow: goes to the correct picture, and to the other one with the counterpart's instruction and the same "
    "images, state and noise; one step: median lateral distance between where the two actions bring the hand, and "
    "in how many episodes any number changed; with the noise drawn anew for comparison"
)


def instruction_swap_table(rows: Sequence[InstructionSwapEffect], context: TableContext) -> "ResponsiveTable":
    """One line per category."""
    from probe_kit._terminal.responsive_table import Part, ResponsiveTable

    columns = ("instruction cm", "images cm", "noise cm", "instruction changes it %", "images change it %")
    return ResponsiveTable(
        title=f"Is the instruction read? {context.subject}",
        caption=_LEGEND,
        name="category",
        names=tuple(row.category for row in rows),
        styles=("",) * len(rows),
        parts=(
            swap_part("Does the action follow the instruction?", rows),
            Part("What one step owes to", columns, tuple(_cells(row.sensitivity) for row in rows)),
        ),
    )


def _cells(own: InputSensitivity) -> "tuple[Cell, ...]":
    from probe_kit._terminal.responsive_table import Cell

    metres = tuple(Cell(f"{100 * value:.2f}") for value in (own.instruction, own.images, own.noise))
    shares = tuple(Cell(f"{100 * value:.1f}") for value in (own.instruction_changed, own.images_changed))
    return metres + shares
