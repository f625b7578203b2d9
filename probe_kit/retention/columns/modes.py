"""The mode of the rows of a table: a policy acts and succeeds, a model that was asked answers right."""

from collections.abc import Iterable, Mapping
from typing import Literal

from probe_kit.retention.rows.row import RetentionRow

Modes = Literal["acts", "answers", "both"]

RATE: Mapping[Modes, str] = {
    "acts": "Success rate",
    "answers": "Accuracy of answers",
    "both": "Success rate / accuracy of answers",
}
"""The share of right episodes at the head of a table or an axis."""
_HEADINGS: Mapping[str, str] = {"SR": "accuracy", "outside": "unread", "goes left": "answers left"}
"""By the first words of a policy's heading, those of a model that was asked."""


def modes_of(rows: Iterable[RetentionRow]) -> Modes:
    """Return what all rows did, `both` for a mixture."""
    modes = {row.run.mode for row in rows}
    return "both" if len(modes) > 1 else "answers" if modes == {"answers"} else "acts"


def heading(name: str, modes: Modes) -> str:
    """A policy's heading, such as `SR % [95 %]`, over rows of `modes`."""
    for acting, asking in _HEADINGS.items():
        if modes != "acts" and name.startswith(acting):
            words = asking if modes == "answers" else f"{acting} / {asking}"
            return f"{words}{name.removeprefix(acting)}"
    return name
