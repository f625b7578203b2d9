"""What the rows of a table did: a policy acts and succeeds, a model that was asked answers right."""

from collections.abc import Iterable, Mapping
from typing import Literal

from probe_kit.retention.rows.row import RetentionRow

Kind = Literal["acts", "asks", "both"]

RATE: Mapping[Kind, str] = {
    "acts": "Success rate",
    "asks": "Accuracy of answers",
    "both": "Success rate / accuracy of answers",
}
"""The share of right episodes at the head of a table or an axis."""
_HEADINGS: Mapping[str, str] = {"SR": "accuracy", "outside": "unread", "goes left": "answers left"}
"""By the first words of a policy's heading, those of a model that was asked."""


def kind_of(rows: Iterable[RetentionRow]) -> Kind:
    """What all rows did, `both` for a mixture."""
    kinds = {row.kind for row in rows}
    return "both" if len(kinds) > 1 else "asks" if kinds == {"asks"} else "acts"


def heading(name: str, kind: Kind) -> str:
    """A policy's heading, such as `SR % [95 %]`, over rows of `kind`."""
    for acting, asking in _HEADINGS.items():
        if kind != "acts" and name.startswith(acting):
            words = asking if kind == "asks" else f"{acting} / {asking}"
            return f"{words}{name.removeprefix(acting)}"
    return name
