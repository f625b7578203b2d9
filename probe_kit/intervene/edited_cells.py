"""The cell that a condition edits, which is stored as columns: place, role, direction, coefficient, and part."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any

SEPARATOR = "|"
"""Separator between place and role, such as `backbone.02|image`, in options and in names of conditions."""
CONTROL = "control-"
"""Beginning of the names of random directions, which distinguishes them in stored results."""
EXACT, ESTIMATE = "exact", "estimate"
"""Parts of a screen by gradients."""
ALONE, WITHOUT = "alone", "without"
"""Parts of joint places: this cell alone, and all cells but it."""
COLUMNS = ("sites", "roles", "directions", "coefficients", "parts")
"""The stored columns of cells, in the order of their fields."""


@dataclass(frozen=True)
class EditedCell:
    """A cell, and how a condition edits it; all texts are empty for a condition that edits no single cell.

    Attributes:
        site: Name of the place.
        role: Role of the tokens.
        direction: Name of the direction; empty if tokens are edited in full.
        coefficient: Coefficient of steering, as text; empty for other edits.
        part: What a kind does with the cell, where it does several things, such as `alone` and `without`.
    """

    site: str = ""
    role: str = ""
    direction: str = ""
    coefficient: str = ""
    part: str = ""

    def __str__(self) -> str:
        """The name of the condition, `part|site|role|direction|coefficient`, without what is empty."""
        parts = (self.part, self.site, self.role, self.direction, self.coefficient)
        return SEPARATOR.join(filter(None, parts))

    @property
    def is_control(self) -> bool:
        """Whether its direction is a random one that another is compared with."""
        return self.direction.startswith(CONTROL)

    def is_control_of(self, other: "EditedCell") -> bool:
        """Whether `other`, no control itself, is compared with this one."""
        same = (self.site, self.role, self.coefficient) == (other.site, other.role, other.coefficient)
        return self.is_control and bool(other.direction) and not other.is_control and same


NO_CELL = EditedCell()
"""The cell of a condition that edits no single one."""


def columns_of(cells: Sequence[EditedCell]) -> dict[str, Any]:
    """Return the columns of K cells by name, (K,) each."""
    values = [astuple(cell) for cell in cells]
    return {name: tuple(value[at] for value in values) for at, name in enumerate(COLUMNS)}


def read_former_name(name: str) -> EditedCell:
    """Return the cell of a condition that was stored with nothing but its name, as by version 0.2."""
    part, _, cell = name.partition(SEPARATOR)
    if part in (EXACT, ESTIMATE, ALONE, WITHOUT):
        return replace(EditedCell(*cell.split(SEPARATOR)), part=part)
    return EditedCell(*name.split(SEPARATOR))
