"""Effects as data frames."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import pandas as pd


class Effect(Protocol):
    """A row of effects, with the interval of its net."""

    def to_json(self) -> dict[str, Any]:
        """Plain values, `net_ci` among them."""


def frame_of(rows: Sequence[Effect]) -> "pd.DataFrame":
    """One line per row; the interval as two columns."""
    import pandas as pd

    flat = []
    for row in rows:
        plain = row.to_json()
        low, high = plain.pop("net_ci")
        flat.append({**plain, "net_ci_low": low, "net_ci_high": high})
    return pd.DataFrame(flat)
