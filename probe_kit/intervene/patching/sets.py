"""Sets of cells: each alone and all but it, and the smallest set that keeps the effect."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from probe_kit.errors import UsageError
from probe_kit.intervene.kinds.joint.cells import Cell, all_but
from probe_kit.intervene.kinds.joint.effects import finding_of_cell
from probe_kit.intervene.kinds.joint.minimal_set import KEEP, find_minimal_set
from probe_kit.intervene.kinds.joint.search import choosing_half
from probe_kit.intervene.kinds.swap_shares import SwapShare, share_of_whole
from probe_kit.intervene.patching.pairs import Pair, groups_and_items
from probe_kit.intervene.patching.sweep import DRAWS, Metric, Sweep, sweep_cells

if TYPE_CHECKING:
    import pandas as pd

    from probe_kit.hooks import Model


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

    own = _several(cells)
    sets = [own, *[(cell,) for cell in own], *[all_but(own, (cell,)) for cell in own]]
    swept = sweep_cells(model, pairs, sets, metric)
    alone = _only(swept, range(1, 1 + len(own)))
    rows = []
    for at, cell in enumerate(own):
        lost = swept.patched[0] - swept.patched[1 + len(own) + at]
        needed = share_of_whole(lost, swept.whole, swept.groups, DRAWS) if alone.shares[at] else None
        p = float(alone.table["p_fwe"][at])
        rows.append(
            {
                "cells": str(cell),
                **_columns("alone", alone.shares[at]),
                **_columns("needed", needed),
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
    own = _several(cells)
    groups, _ = groups_and_items(pairs)
    choosing = choosing_half(groups, seed)
    chosen = [pair for pair, group in zip(pairs, groups, strict=True) if group in choosing]
    others = [pair for pair, group in zip(pairs, groups, strict=True) if group not in choosing]
    if not chosen:
        raise UsageError(f"{len(set(groups))} group of pairs cannot be halved; give pairs of at least two groups")

    def effects(sets: Sequence[tuple[Cell, ...]]) -> list[float]:
        swept = sweep_cells(model, chosen, sets, metric)
        total = float((swept.whole**2).sum())
        return [
            float(((one - swept.clean) * swept.whole).sum()) / total if total else 0.0 for one in swept.patched
        ]

    found = find_minimal_set(own, effects, keep)
    scored = sweep_cells(model, others, [found.cells], metric)
    return MinimalCells(
        found.cells, found.effect, found.tried, scored.shares[0], float(scored.table["p"][0]), choosing
    )


def _several(cells: Sequence[Cell]) -> tuple[Cell, ...]:
    own = tuple(dict.fromkeys(cells))
    if len(own) < 2:
        raise UsageError(
            f"a comparison of sets needs two cells or more; {', '.join(map(str, own)) or 'none'} given"
        )
    return own


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


def _columns(name: str, share: SwapShare | None) -> dict[str, float]:
    value, low, high = (np.nan,) * 3 if share is None else share
    return {name: value, f"{name}_low": low, f"{name}_high": high}
