"""What came of it, and its table. Needs no model."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from probe_kit._terminal.responsive_table import Cell, Part, ResponsiveTable
from probe_kit.intervene.kinds.base import Measurement, TableContext
from probe_kit.intervene.store.answers import CLEAN


@dataclass(frozen=True)
class DimmedEffect:
    """Median metres by which the action moves, in one category, with a share of the contrast."""

    category: str
    condition: str
    n_episodes: int
    median_displacement: float
    key: str = ""

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def dimmed_effects(measurement: Measurement) -> list[DimmedEffect]:
    """One per category and share."""
    return [
        DimmedEffect(category, name, own.episodes.size, _median(own.of(name) - own.of(CLEAN)), measurement.key)
        for category, own in measurement.outcomes.by_category()
        for name in own.conditions[1:]
    ]


def dimmed_table(rows: Sequence[DimmedEffect], context: TableContext) -> ResponsiveTable:
    """One line per category and share."""
    return ResponsiveTable(
        title=f"Is the image read? {context.subject}",
        caption="displacement: median lateral distance from the clean action",
        name="category · condition",
        names=tuple(f"{row.category} · {row.condition}" for row in rows),
        styles=("",) * len(rows),
        parts=(
            Part(
                "Action",
                ("displacement cm",),
                tuple((Cell(f"{100 * row.median_displacement:.2f}"),) for row in rows),
            ),
        ),
    )


def _median(values: Any) -> float:
    return float(np.median(np.abs(values)))
