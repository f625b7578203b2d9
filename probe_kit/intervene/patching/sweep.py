"""A sweep: every cell patched alone, or every set of cells together, in every pair, and what it moves."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.intervene.pairs import Given, Pair, groups_and_items
from probe_kit.intervene.patching.inference import infer, run_with_cache
from probe_kit.intervene.patching.patch import Basis, Cell, Cells, as_tuple, infer_patched
from probe_kit.intervene.places import PlaceName
from probe_kit.statistics.bootstrap import draw_groups, units_seed
from probe_kit.statistics.paired_tests import max_t, paired_greater_p
from probe_kit.statistics.significance import SIGNIFICANCE

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from probe_kit.hooks import Model


class SwapShare(NamedTuple):
    """A ratio of sums over episodes, with its 95 % interval by groups; 1 is the whole swap."""

    value: float
    low: float
    high: float


def share_of_whole(
    moved: NDArray[np.float64], full: NDArray[np.float64], groups: NDArray[np.str_], seed_text: str
) -> SwapShare:
    """Return Σ moved · whole / Σ whole² over episodes (E,), with its interval by groups (E,)."""
    names, group_of = np.unique(groups, return_inverse=True)
    above, below = np.bincount(group_of, moved * full), np.bincount(group_of, full**2)
    times = draw_groups(names.size, units_seed(groups, seed_text))
    # A draw may hold only groups in which the source moves nothing.
    drawn = (times @ above) / np.maximum(times @ below, np.finfo(float).tiny)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return SwapShare(float(above.sum() / below.sum()), float(low), float(high))


def share_fields(name: str, share: SwapShare | None) -> dict[str, Any]:
    """Return a share and its interval as fields of a row of effects."""
    if share is None:
        return {name: None, f"{name}_ci": None}
    return {name: share.value, f"{name}_ci": (share.low, share.high)}


def share_columns(name: str, share: SwapShare | None) -> dict[str, float]:
    """Return a share and its interval as columns of a data frame."""
    value, low, high = (np.nan,) * 3 if share is None else share
    return {name: value, f"{name}_low": low, f"{name}_high": high}


Metric = Callable[[Any, Given], float]
"""From the output of an inference and what was given to it to a number, such as metres to the left."""
DRAWS = "patching"
"""Name of the seed of all draws over pairs."""


@dataclass(frozen=True)
class Sweep:
    """The effects of K sets of cells in E pairs.

    cells: the sets. groups, items: (E,) of the pairs. toward: (E,) ±1, see `Pair`. clean, source: (E,) the metric
    of both inferences; patched: (K, E) of those with a set of cells patched.
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
        """Return the cells of every set, joined by +."""
        return tuple(" + ".join(map(str, cells)) for cells in self.cells)

    @property
    def full_effect(self) -> NDArray[np.float64]:
        """(E,) by how much the source differs from the clean inference."""
        return self.source - self.clean

    @cached_property
    def source_p(self) -> float:
        """Return p that the source moves the metric, in the better direction: exact sign test, as of the swap."""
        return min(self._source_p_values)

    @cached_property
    def _source_p_values(self) -> tuple[float, float]:
        """Toward where the source should move the metric, and away from it."""
        moved = self.toward * self.full_effect
        toward, away = (paired_greater_p(sign * moved, self.items, self.groups) for sign in (1.0, -1.0))
        return toward, away

    @cached_property
    def shares(self) -> tuple[SwapShare | None, ...]:
        """Per set its share of the source's effect with a 95 % interval by groups; see `table`."""
        if self.source_p >= SIGNIFICANCE:
            return (None,) * len(self.cells)
        return tuple(
            share_of_whole(values - self.clean, self.full_effect, self.groups, DRAWS) for values in self.patched
        )

    @cached_property
    def table(self) -> "pd.DataFrame":
        """One row per set of cells.

        share, low, high: Σ moved · whole / Σ whole² over pairs, 1 for all that the source does, with its 95 %
        interval by groups; NaN where the source itself is not significant, as with four groups or fewer: it
        would be a ratio of noise. moved: mean of the metric toward `Pair.toward`, in its unit. p, p_fwe:
        that it moves where the source does, by sign flips of whole groups; p_fwe against all sets (max-T).
        """
        import pandas as pd

        moved = self.toward * (self.patched - self.clean)
        seed = derive_seed(DRAWS, "sign flips", *np.unique(self.groups).tolist())
        # Where the source moves the metric the other way, a patch that follows it is tested in that direction.
        sign = -1.0 if self._source_p_values[1] < SIGNIFICANCE else 1.0
        _, p, p_fwe = max_t(sign * moved, self.items, self.groups, seed)
        shares = [(np.nan,) * 3 if share is None else tuple(share) for share in self.shares]
        return pd.DataFrame(
            {
                "cells": self.names,
                **dict(zip(("share", "low", "high"), np.array(shares).T, strict=True)),
                "moved": moved.mean(axis=1),
                "p": p,
                "p_fwe": p_fwe,
                "n_pairs": self.clean.size,
                "n_groups": np.unique(self.groups).size,
            }
        )

    def heatmap(self, column: str = "share") -> "Figure":
        """Cells by layer and role, coloured by a column of the table.

        Raises UsageError for sets of several cells, or without any number in the column.
        """
        from matplotlib.figure import Figure

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
        figure = Figure(figsize=(2 + 0.4 * len(places), 1.5 + 0.4 * len(roles)), layout="constrained")
        axes = figure.add_subplot()
        image = axes.imshow(grid, aspect="auto", cmap="viridis")
        axes.set_xticks(range(len(places)), places, rotation=90)
        axes.set_yticks(range(len(roles)), roles)
        figure.colorbar(image, label=column)
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

    metric: of an output and what was given, such as `session.lateral_displacement`; of the same inference as the
    patch. along, complement: see `patch_cells`. Raises UsageError without pairs, and what `patch_cells` raises.
    """
    sets = tuple(as_tuple(together) for together in cells)
    if not pairs or not sets:
        raise UsageError(f"a sweep of {len(sets)} sets of cells in {len(pairs)} pairs; give at least one of both")
    places = list(dict.fromkeys(cell.site_group.name for together in sets for cell in together))
    clean, moved = np.empty(len(pairs)), np.empty(len(pairs))
    patched = np.empty((len(sets), len(pairs)))
    for column, pair in enumerate(pairs):
        output, source = run_with_cache(model, pair.source, pair.seed, places)
        moved[column] = metric(output, pair.source)
        clean[column] = metric(infer(model, pair.clean, pair.seed), pair.clean)
        for row, together in enumerate(sets):
            output = infer_patched(model, pair, together, source, along, complement)
            patched[row, column] = metric(output, pair.clean)
    groups, items = groups_and_items(pairs)
    toward = np.array([float(np.sign(pair.toward)) for pair in pairs])
    return Sweep(sets, np.array(groups), np.array(items), toward, clean, moved, patched)


def _order(name: PlaceName) -> tuple[object, ...]:
    return name.stream, *name.depth
