"""Sets of cells: each alone and all but it, and the smallest set that keeps the effect."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.intervene.pairs import Pair, groups_and_items
from probe_kit.intervene.patching.patch import Cell, all_but
from probe_kit.intervene.patching.sweep import (
    DRAWS,
    Metric,
    SwapShare,
    Sweep,
    share_columns,
    share_of_whole,
    sweep_cells,
)
from probe_kit.statistics.significance import SIGNIFICANCE

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.hooks import Model


MOST_SINGLY = 30
"""Cells up to which each is left out in turn; of more, halves are, then quarters and so on (delta debugging)."""
KEEP = 0.9
"""Share of the whole set's effect that the smaller one must keep."""
CARRIES, NOTHING = 0.5, 0.1
"""Shares of the swap from which a set carries it, and below which, on both sides of 0, it carries nothing."""


@dataclass(frozen=True)
class MinimalSet[C]:
    """A set of which no cell can be left out. effect: of these cells. tried: how many sets were tried."""

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
    (full,) = effects([have])
    effect, tried, is_singly = full, 1, len(have) <= MOST_SINGLY
    parts = len(have) if is_singly else 2
    while len(have) > 1:
        smaller = [_without(have, chunk) for chunk in np.array_split(np.arange(len(have)), parts)]
        shares = effects(smaller)
        tried += len(smaller)
        best = int(np.argmax(shares))
        if shares[best] >= keep * full:
            have, effect = smaller[best], shares[best]
            # Delta debugging: after a success as fine as before, but for the part that is gone.
            parts = len(have) if is_singly else max(2, min(parts - 1, len(have)))
        elif parts < len(have):
            parts = min(2 * parts, len(have))
        else:  # no single cell can be left out
            break
    return MinimalSet(have, effect, tried)


def _without[C](cells: tuple[C, ...], left_out: Sequence[int]) -> tuple[C, ...]:
    gone = set(map(int, left_out))
    return tuple(cell for number, cell in enumerate(cells) if number not in gone)


def pooled_share(moved: NDArray[np.float64], full: NDArray[np.float64]) -> float:
    """Return Σ moved · whole / Σ whole² over pairs (E,); 0 where the whole moves nothing."""
    total = float((full**2).sum())
    return float((moved * full).sum()) / total if total else 0.0


def choosing_half(groups: Sequence[str], seed: int) -> tuple[str, ...]:
    """Return one half of the groups, by a drawn order; the larger one of an odd number stays for scoring."""
    names = sorted(set(groups))
    order = np.random.default_rng(derive_seed("joint places", seed, *names)).permutation(len(names))
    return tuple(sorted(names[at] for at in order[: len(names) // 2]))


def carries_nothing(low: float, high: float) -> bool:
    """Whether an interval of a share of the swap excludes, on both sides of 0, what would matter."""
    return low > -NOTHING and high < NOTHING


def finding_of_cell(alone: SwapShare | None, needed: SwapShare | None, every: SwapShare | None, p: float) -> str:
    """Return a cell's finding from its shares alone and needed, all cells' share, and p of it alone."""
    if alone is None or needed is None or every is None:
        return "n/a"
    carries = alone.value >= CARRIES and p < SIGNIFICANCE
    if carries and needed.value >= CARRIES:
        return "read here"
    if carries and carries_nothing(needed.low, needed.high):
        return "enough alone"
    if carries_nothing(alone.low, alone.high) and needed.value >= CARRIES:
        return "needed, not enough"
    if max(alone.high, needed.high) < -NOTHING:
        return "opposes it"
    return (
        "nothing alone"
        if carries_nothing(alone.low, alone.high) and carries_nothing(needed.low, needed.high)
        else "in part"
    )


@dataclass(frozen=True)
class MinimalCells:
    """The smallest set of cells that keeps an effect, and what it does in pairs in which it was not searched.

    cells: of them none can be left out. chosen_effect: their share in the pairs of the search, of `tried` sets.
    share: in the other half of the groups, with its interval; None where the source is not significant there.
    p: that the set moves the metric toward the source there. choosing: groups of the search.
    """

    cells: tuple[Cell, ...]
    chosen_effect: float
    tried: int
    share: SwapShare | None
    p: float
    choosing: tuple[str, ...]


def compare_alone_and_without(
    model: "Model", pairs: Sequence[Pair], cells: Sequence[Cell], metric: Metric
) -> "pd.DataFrame":
    """One row per cell: what it carries alone, and what all cells lose without it.

    Columns: cells; alone with alone_low, alone_high: share of the source's effect; needed with needed_low,
    needed_high: (all cells) − (all but it), as a share; p_fwe of the cell alone; finding as of `--kind joint`,
    "n/a" where the source is not significant. The cells must be parallel: blocks of `kv`, roles or heads of one
    layer. Raises UsageError for fewer than two cells.
    """
    import pandas as pd

    distinct = _several(cells)
    sets = [distinct, *[(cell,) for cell in distinct], *[all_but(distinct, (cell,)) for cell in distinct]]
    swept = sweep_cells(model, pairs, sets, metric)
    # The family of max-T: cells alone. All cells together, and all but one, are no tests of a cell.
    alone = _only(swept, range(1, 1 + len(distinct)))
    rows = []
    for at, cell in enumerate(distinct):
        lost = swept.patched[0] - swept.patched[1 + len(distinct) + at]
        needed = share_of_whole(lost, swept.full_effect, swept.groups, DRAWS) if alone.shares[at] else None
        p = float(alone.table["p_fwe"][at])
        rows.append(
            {
                "cells": str(cell),
                **share_columns("alone", alone.shares[at]),
                **share_columns("needed", needed),
                "p_fwe": p,
                "finding": finding_of_cell(alone.shares[at], needed, swept.shares[0], p),
            }
        )
    return pd.DataFrame(rows)


def find_minimal_cells(
    model: "Model",
    pairs: Sequence[Pair],
    cells: Sequence[Cell],
    metric: Metric,
    *,
    keep: float = KEEP,
    seed: int = 0,
) -> MinimalCells:
    """The smallest set of cells that keeps the share `keep` of what all of them carry.

    It is searched in one half of the groups, drawn with `seed`, and scored in the other; see `find_minimal_set`.
    The cells must be parallel. Raises UsageError for fewer than two cells, or fewer than two groups.
    """
    distinct = _several(cells)
    groups, _ = groups_and_items(pairs)
    choosing = choosing_half(groups, seed)
    searched = [pair for pair, group in zip(pairs, groups, strict=True) if group in choosing]
    held_out = [pair for pair, group in zip(pairs, groups, strict=True) if group not in choosing]
    if not searched:
        raise UsageError(f"{len(set(groups))} group of pairs cannot be halved; give pairs of at least two groups")

    def effects(sets: Sequence[tuple[Cell, ...]]) -> list[float]:
        swept = sweep_cells(model, searched, sets, metric)
        return [pooled_share(values - swept.clean, swept.full_effect) for values in swept.patched]

    smallest = find_minimal_set(distinct, effects, keep)
    scored = sweep_cells(model, held_out, [smallest.cells], metric)
    return MinimalCells(
        smallest.cells, smallest.effect, smallest.tried, scored.shares[0], float(scored.table["p"][0]), choosing
    )


def _several(cells: Sequence[Cell]) -> tuple[Cell, ...]:
    distinct = tuple(dict.fromkeys(cells))
    if len(distinct) < 2:
        raise UsageError(
            f"a comparison of sets needs two cells or more; {', '.join(map(str, distinct)) or 'none'} given"
        )
    return distinct


def _only(swept: Sweep, rows: range) -> Sweep:
    """Some of the sets, tested among themselves."""
    return Sweep(
        tuple(swept.cells[row] for row in rows),
        swept.groups,
        swept.items,
        swept.toward,
        swept.clean,
        swept.source,
        swept.patched[np.array(rows)],
    )
