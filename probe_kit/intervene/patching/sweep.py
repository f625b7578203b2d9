"""A sweep of sets of cells over pairs, and the smallest set that keeps the effect."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.intervene.exchange import Exchange, SwapShare, pooled_share, share_columns
from probe_kit.intervene.pairs import Given, Pair, groups_and_items
from probe_kit.intervene.patching.patch import (
    Basis,
    Cell,
    Cells,
    all_but,
    as_tuple,
    infer,
    patch_while_inferring,
    run_with_cache,
)
from probe_kit.intervene.places import PlaceName
from probe_kit.intervene.tokens import PairTokens

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from probe_kit.hooks import Model


Metric = Callable[[Any, Given], float]
"""Function from the output of an inference and its input to a number, such as metres to the left."""
CELL_INCHES = 0.4
"""Width and height of a cell of a heatmap, in inches."""
SEED_TEXT = "patching"
"""Text that seeds all random draws over pairs: for a run it is the run's `seed_text`."""


@dataclass(frozen=True)
class Sweep:
    """The effects of K sets of cells in E pairs.

    Attributes:
        cells: The K sets of cells.
        groups: (E,) group of every pair.
        items: (E,) item of every pair.
        toward: (E,) ±1, see `Pair`.
        clean: (E,) metric of the clean inferences.
        source: (E,) metric of the sources' inferences.
        patched: (K, E) metric of the clean inferences with a set of cells patched.
    """

    cells: tuple[tuple[Cell, ...], ...]
    groups: NDArray[np.str_]
    items: NDArray[np.str_]
    toward: NDArray[np.float64]
    clean: NDArray[np.float64]
    source: NDArray[np.float64]
    patched: NDArray[np.float64]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the cells of every set, joined by +."""
        return tuple(" + ".join(map(str, cells)) for cells in self.cells)

    @cached_property
    def exchange(self) -> Exchange:
        """The effect of the source."""
        seed = derive_seed(SEED_TEXT, "sign flips", *np.unique(self.groups).tolist())
        return Exchange(self.clean, self.source, self.toward, self.groups, self.items, SEED_TEXT, seed)

    @property
    def full_effect(self) -> NDArray[np.float64]:
        """The difference (E,) of the source from the clean inference."""
        return self.exchange.full

    @property
    def source_p(self) -> float:
        """The p-value that the source moves the metric, in the better direction, by an exact sign test."""
        return min(self.exchange.p_values)

    @cached_property
    def shares(self) -> tuple[SwapShare | None, ...]:
        """The share of the source's effect of each set, with a 95 % interval by groups; see `table`."""
        return tuple(self.exchange.share(values - self.clean) for values in self.patched)

    @cached_property
    def table(self) -> "pd.DataFrame":
        """The sweep as one row per set of cells.

        share, low, high: Σ moved · whole / Σ whole² over pairs, 1 for all that the source does, with its 95 %
        interval by groups. NaN where the source itself is not significant, as with four groups or fewer: it would
        be a ratio of noise.

        moved: mean of the metric toward `Pair.toward`, in its unit.

        p, p_fwe: that it moves where the source does, by sign flips of whole groups; p_fwe against all sets
        (max-T).
        """
        import pandas as pd

        moved = self.patched - self.clean
        _, p, p_fwe = self.exchange.test(moved)
        shares = [(np.nan,) * 3 if share is None else tuple(share) for share in self.shares]
        return pd.DataFrame(
            {
                "cells": self.names,
                **dict(zip(("share", "low", "high"), np.array(shares).T, strict=True)),
                "moved": (self.toward * moved).mean(axis=1),
                "p": p,
                "p_fwe": p_fwe,
                "n_pairs": self.clean.size,
                "n_groups": np.unique(self.groups).size,
            }
        )

    def heatmap(self, column: str = "share") -> "Figure":
        """Draw cells by layer and role, coloured by a column of the table.

        Raises:
            UsageError: For sets of several cells, or without any number in the column.
        """
        from matplotlib.figure import Figure
        from matplotlib.ticker import MaxNLocator

        if any(len(cells) > 1 for cells in self.cells):
            raise UsageError("a heatmap shows single cells; this sweep has sets of several, use its table")
        values = self.table[column].to_numpy(float)
        if np.isnan(values).all():
            raise UsageError(
                f"no cell has a {column}: p of the source itself is {self.source_p:.2g}; take 'moved'"
            )
        places = sorted(
            {cells[0].site_group.name for cells in self.cells}, key=lambda name: _order(PlaceName.parse(name))
        )
        roles = list(dict.fromkeys(cells[0].role for cells in self.cells))
        grid = np.full((len(roles), len(places)), np.nan)
        for (cell,), value in zip(self.cells, values, strict=True):
            grid[roles.index(cell.role), places.index(cell.site_group.name)] = value
        # The layout takes the room of long names from the cells: names are measured in a large figure first.
        width, height = (max(CELL_INCHES * count, 1.2) for count in (len(places), len(roles)))
        figure = Figure(figsize=(width + 20, height + 20), layout="constrained")
        axes = figure.add_subplot()
        image = axes.imshow(grid, aspect="auto", cmap="viridis")
        axes.set_xticks(range(len(places)), places, rotation=90)
        axes.set_yticks(range(len(roles)), roles)
        figure.colorbar(image, label=column, ticks=MaxNLocator(max(2, int(2 * height))))
        figure.draw_without_rendering()
        label_height, label_width = (
            max(getattr(name.get_window_extent(), side) for name in names) / figure.dpi
            for names, side in ((axes.get_xticklabels(), "height"), (axes.get_yticklabels(), "width"))
        )
        figure.set_size_inches(width + label_width + 1.4, height + label_height + 0.4)
        return figure


def sweep_cells(
    model: "Model",
    pairs: Sequence[Pair],
    cells: Sequence[Cells],
    metric: Metric,
    *,
    along: Basis | None = None,
    complement: bool = False,
) -> Sweep:
    """Patch every cell, or every set of cells, of `cells` in every pair; one inference each, and two per pair.

    Raises as `patch_cells` too.

    Args:
        model: Policy, or model that answers.
        pairs: Pairs of inputs.
        cells: Cells, or sets of cells that are patched together.
        metric: Function of an output and its input, such as `session.lateral_displacement`. It is measured in the
            inference that is patched.
        along: (K, D) orthonormal rows, see `patch_cells`; None to patch in full.
        complement: Whether to patch all but the component within `along`.

    Raises:
        UsageError: Without pairs or cells.
    """
    sets = tuple(as_tuple(together) for together in cells)
    if not pairs or not sets:
        raise UsageError(f"a sweep of {len(sets)} sets of cells in {len(pairs)} pairs; give at least one of both")
    places = list(dict.fromkeys(cell.site_group.name for together in sets for cell in together))
    clean, moved = np.empty(len(pairs)), np.empty(len(pairs))
    of_sets = np.empty((len(sets), len(pairs)))
    for column, pair in enumerate(pairs):
        output, source = run_with_cache(model, pair.source, pair.seed, places)
        moved[column] = metric(output, pair.source)
        clean[column] = metric(infer(model, pair.clean, pair.seed), pair.clean)
        tokens = PairTokens(model, pair)
        for row, together in enumerate(sets):
            with patch_while_inferring(tokens, together, source, along, complement):
                output = infer(model, pair.clean, pair.seed)
            of_sets[row, column] = metric(output, pair.clean)
    groups, items = groups_and_items(pairs)
    toward = np.array([float(np.sign(pair.toward)) for pair in pairs])
    return Sweep(sets, np.array(groups), np.array(items), toward, clean, moved, of_sets)


def _order(name: PlaceName) -> tuple[object, ...]:
    return name.stream, *name.depth


MOST_SINGLY = 30
"""Number of cells up to which each is left out in turn.

Of more, halves are left out, then quarters and so on (delta debugging). Singly takes up to n (n + 1) / 2 sets,
each an inference per pair: 465 for 30 cells, 2,485 for 70.
"""
KEEP = 0.9
"""Share of the whole set's effect that the smaller one must keep; the rest is `exchange.NOTHING`."""


def find_minimal_set[C](
    cells: Sequence[C], effects: Callable[[Sequence[tuple[C, ...]]], Sequence[float]], keep: float = KEEP
) -> tuple[tuple[C, ...], float, int]:
    """Leave out cells while `keep` of the effect of all of them stays; of equal ones the first is left out.

    At most n (n + 1) / 2 sets of up to `MOST_SINGLY` cells are tried. Adding cells one by one would stop at once
    where a majority decides: no first cell has an effect.

    Args:
        cells: All cells.
        effects: Function that returns the effect of each of some sets.
        keep: Share of the effect of all cells that a set must keep.

    Returns:
        A set of which no cell can be left out, its effect, and the number of sets that were tried.
    """
    have = tuple(cells)
    (full,) = effects([have])
    effect, tried, is_singly = full, 1, len(have) <= MOST_SINGLY
    parts = len(have) if is_singly else 2
    while len(have) > 1:
        smaller = [
            tuple(cell for at, cell in enumerate(have) if at not in left_out)
            for left_out in np.array_split(np.arange(len(have)), parts)
        ]
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
    return have, effect, tried


def choosing_half(groups: Sequence[str], seed: int) -> tuple[str, ...]:
    """Return one half of the groups, by a drawn order; the larger one of an odd number stays for scoring."""
    names = sorted(set(groups))
    order = np.random.default_rng(derive_seed("joint places", seed, *names)).permutation(len(names))
    return tuple(sorted(names[at] for at in order[: len(names) // 2]))


@dataclass(frozen=True)
class MinimalCells:
    """The smallest set of cells that keeps an effect, and its effect in pairs in which it was not searched.

    Attributes:
        cells: Cells of the set, of which none can be left out.
        chosen_effect: Share of the source's effect in the pairs of the search.
        tried: Number of sets that were tried.
        share: Share in the other half of the groups, with its interval; None where the source is not significant
            there.
        p: The p-value that the set moves the metric toward the source there.
        choosing: Groups of the search.
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
    """Return one row per cell: its effect alone, and what all cells lose without it.

    Columns are cells; alone with alone_low, alone_high: share of the source's effect; needed with needed_low,
    needed_high: (all cells) − (all but it), as a share; p_fwe of the cell alone; finding as of `--kind joint`,
    "n/a" where the source is not significant. The cells must be parallel: blocks of `kv`, roles or heads of one
    layer.

    Raises:
        UsageError: For fewer than two cells.
    """
    import pandas as pd

    distinct = _several(cells)
    sets = [distinct, *[(cell,) for cell in distinct], *[all_but(distinct, (cell,)) for cell in distinct]]
    swept = sweep_cells(model, pairs, sets, metric)
    # The family of max-T: cells alone. All cells together, and all but one, are no tests of a cell.
    every, alone = swept.patched[0], swept.patched[1 : 1 + len(distinct)]
    lost = every - swept.patched[1 + len(distinct) :]
    readings = swept.exchange.readings(every - swept.clean, alone - swept.clean, lost)
    lines = [
        {
            "cells": str(cell),
            **share_columns("alone", reading.alone),
            **share_columns("needed", reading.needed),
            "p_fwe": reading.p_fwe,
            "finding": reading.finding,
        }
        for cell, reading in zip(distinct, readings, strict=True)
    ]
    return pd.DataFrame(lines)


def find_minimal_cells(
    model: "Model",
    pairs: Sequence[Pair],
    cells: Sequence[Cell],
    metric: Metric,
    *,
    keep: float = KEEP,
    seed: int = 0,
) -> MinimalCells:
    """Search the smallest set of cells that keeps the share `keep` of what all of them carry.

    It is searched in one half of the groups, drawn with `seed`, and scored in the other; see `find_minimal_set`.
    The cells must be parallel.

    Raises:
        UsageError: For fewer than two cells, or fewer than two groups.
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

    smallest, effect, tried = find_minimal_set(distinct, effects, keep)
    scored = sweep_cells(model, held_out, [smallest], metric)
    return MinimalCells(smallest, effect, tried, scored.shares[0], float(scored.table["p"][0]), choosing)


def _several(cells: Sequence[Cell]) -> tuple[Cell, ...]:
    distinct = tuple(dict.fromkeys(cells))
    if len(distinct) < 2:
        raise UsageError(
            f"a comparison of sets needs two cells or more; {', '.join(map(str, distinct)) or 'none'} given"
        )
    return distinct
