"""The interface of a category: its concepts, which two may meet, and a pair of tiles for them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from PIL import Image


@dataclass(frozen=True)
class Concept:
    """What one picture shows, and the words that ask for it."""

    name: str
    phrase: str
    polarity: Literal["pos", "neg", "none"] = "none"


class Tile(Protocol):
    """Everything one picture is drawn from: a frozen dataclass of plain values, and so a record of it."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def draw(self) -> Image.Image:
        """The picture, RGB; equal tiles give equal pixels."""


@dataclass(frozen=True)
class Generator[C: Concept]:
    """One category of the embedded suite.

    pairs: every two concepts that may lie side by side, each couple once.
    tiles: draws the two tiles of a couple. Whatever does not show the concepts must be drawn for both from
        the same distribution, because which of the two is asked for is decided elsewhere.
    named: what a tile literally shows, in words that need no knowledge, for the wording `named`; empty where there
        are none that say more than the concept does. None if the category has no such words.
    """

    category: str
    pairs: tuple[tuple[C, C], ...]
    tiles: Callable[[C, C, np.random.Generator], tuple[Tile, Tile]]
    named: Callable[[Any], str] | None = None
