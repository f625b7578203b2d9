"""The smallest set of cells that keeps most of an effect, by leaving out what costs least."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

MOST_SINGLY = 30
"""Cells up to which each is left out in turn; of more, halves are, then quarters and so on (delta debugging)."""
KEEP = 0.9
"""Share of the whole set's effect that the smaller one must keep."""


@dataclass(frozen=True)
class MinimalSet[C]:
    """cells: of them none can be left out. effect: of these cells. tried: how many sets were tried."""

    cells: tuple[C, ...]
    effect: float
    tried: int


def find_minimal_set[C](
    cells: Sequence[C], effects: Callable[[Sequence[tuple[C, ...]]], Sequence[float]], keep: float = KEEP
) -> MinimalSet[C]:
    """Leave out cells while `keep` of the effect of all of them stays; of equal ones the first is left out.

    effects: the effect of each of some sets. At most n (n + 1) / 2 sets of up to `MOST_SINGLY` cells are tried.
    Adding cells one by one would stop at once where a majority decides: no first cell has an effect.
    """
    have = tuple(cells)
    (whole,) = effects([have])
    effect, tried, is_singly = whole, 1, len(have) <= MOST_SINGLY
    parts = len(have) if is_singly else 2
    while len(have) > 1:
        smaller = [_without(have, chunk) for chunk in np.array_split(np.arange(len(have)), parts)]
        found = effects(smaller)
        tried += len(smaller)
        best = int(np.argmax(found))
        if found[best] >= keep * whole:
            have, effect = smaller[best], found[best]
            parts = len(have) if is_singly else max(2, min(parts - 1, len(have)))
        elif parts < len(have):
            parts = min(2 * parts, len(have))
        else:
            break
    return MinimalSet(have, effect, tried)


def _without[C](cells: tuple[C, ...], left_out: Sequence[int]) -> tuple[C, ...]:
    gone = set(map(int, left_out))
    return tuple(cell for number, cell in enumerate(cells) if number not in gone)
