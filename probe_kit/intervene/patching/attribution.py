"""A screen by gradients over pairs: estimates for all cells, and exact patches of the anchors that test them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.edits.sites import mask_of
from probe_kit.intervene.kinds.attribution.effects import (
    AttributionEffect,
    order_cells,
    share_fields,
    worst_anchor,
)
from probe_kit.intervene.kinds.attribution.screen import complete_cuts, sum_over_cells
from probe_kit.intervene.kinds.attribution.table import describe_screen
from probe_kit.intervene.kinds.joint.cells import Cell
from probe_kit.intervene.kinds.swap_shares import share_of_whole
from probe_kit.intervene.patching.inference import roles_of_tokens, run_with_cache
from probe_kit.intervene.patching.pairs import Pair
from probe_kit.intervene.patching.sweep import DRAWS, Sweep, sweep_cells
from probe_kit.statistics.significance import SIGNIFICANCE

if TYPE_CHECKING:
    import pandas as pd
    from torch import Tensor

    from probe_kit.hooks import Policy

Slope = Callable[["Tensor"], "Tensor"]
"""From actions (chunk, 7) to a number with a graph, such as metres to the left."""


@dataclass(frozen=True)
class Screen:
    """What gradients estimate of each cell, and whether they can be believed.

    rows: the anchors, then the cells of each kind by rank; in a void screen in the order in which they were given.
    cells: by name.
    """

    rows: tuple[AttributionEffect, ...]
    cells: Mapping[str, Cell]

    @property
    def finding(self) -> str:
        """`anchored`, `void`, or `n/a` where no anchor carries the effect of the source."""
        return self.rows[0].finding

    @property
    def anchor(self) -> AttributionEffect | None:
        """Of the complete cuts that carry the effect, the one that its estimate misses most; None without one."""
        return worst_anchor(self.rows)

    @cached_property
    def table(self) -> "pd.DataFrame":
        """One row per anchor and cell.

        Columns: cells; kind, empty for an anchor; rank within the kind, NaN unless the screen is anchored;
        estimate with estimate_low, estimate_high; exact with exact_low, exact_high, of anchors alone. Shares are
        NaN where the source itself is not significant.
        """
        import pandas as pd

        return pd.DataFrame(
            {
                "cells": [row.name for row in self.rows],
                "kind": [row.kind for row in self.rows],
                "rank": [np.nan if row.rank is None else row.rank for row in self.rows],
                **_columns("estimate", [(row.estimate, row.estimate_ci) for row in self.rows]),
                **_columns("exact", [(row.exact, row.exact_ci) for row in self.rows]),
            }
        )

    def choose(self, top: int = 20, drawn: int = 20, seed: int = 0) -> tuple[tuple[Cell, ...], tuple[Cell, ...]]:
        """Cells for exact patches: of each kind the `top` largest estimates, and `drawn` of all other cells.

        The largest exact effect of the drawn ones bounds what the screen missed. Raises UsageError for a screen
        that is not anchored: it has no order.
        """
        if self.finding != "anchored":
            raise UsageError(f"{self}; patch cells exactly with sweep_cells, or sets with find_minimal_cells")
        ranked = [row for row in self.rows if row.rank is not None]
        largest = [row.name for row in ranked if (row.rank or 0) <= top]
        rest = [row.name for row in ranked if (row.rank or 0) > top]
        draw = np.random.default_rng(derive_seed("screen", seed)).permutation(len(rest))[:drawn]
        names = largest, [rest[at] for at in sorted(draw.tolist())]
        chosen, others = (tuple(self.cells[name] for name in own) for own in names)
        return chosen, others

    def __str__(self) -> str:
        return describe_screen(self.rows)


def attribute_cells(model: "Policy", pairs: Sequence[Pair], cells: Sequence[Cell], metric: Slope) -> Screen:
    """Estimate what a patch of every cell would do, by attribution patching, and test the estimates on anchors.

    The estimate is Σ (source − clean) · ∂ metric / ∂ activation at the clean inference (Syed et al. 2023,
    https://arxiv.org/abs/2310.10348). Anchors are patched exactly: all of `kv`, and all tokens of each layer of
    the backbone with a cell. If one that carries the effect is missed by more than a factor of 3, the screen is
    void.

    metric: of actions (chunk, 7), with a graph, such as `session.lateral_motion`. Cost per pair: two inferences,
    one with a backward pass, and one per anchor. Raises UnsupportedInterventionError, before any inference, for a
    family without gradients; UsageError without pairs or cells, and for pairs of questions.
    """
    own = tuple(dict.fromkeys(cells))
    model.interventions.check("gradients", model.card.family)
    if not pairs or not own:
        raise UsageError(f"a screen of {len(own)} cells in {len(pairs)} pairs; give at least one of both")
    if not all(isinstance(pair.clean, Observation) for pair in pairs):
        raise UsageError("gradients are of actions; give pairs of observations, not of questions")
    anchors = complete_cuts(model, list(dict.fromkeys(cell.place for cell in own)))
    every = (*anchors, *(cell for cell in own if cell not in anchors))
    estimates = np.array([_estimates(model, pair, every, metric) for pair in pairs]).T
    exact = sweep_cells(model, pairs, anchors, lambda actions, _: _number(metric, actions))
    rows = [_row(cell, moved, exact, anchors) for cell, moved in zip(every, estimates, strict=True)]
    return Screen(tuple(order_cells(rows)), {str(cell): cell for cell in every})


def _estimates(model: "Policy", pair: Pair, cells: Sequence[Cell], metric: Slope) -> NDArray[np.float64]:
    """(C,) of one pair, in the unit of the metric."""
    from probe_kit.hooks import gradients_at

    assert isinstance(pair.clean, Observation)
    places = list(dict.fromkeys(cell.place.name for cell in cells))
    _, own = run_with_cache(model, pair.clean, pair.seed, places)
    _, source = run_with_cache(model, pair.source, pair.seed, places)
    sites = dict.fromkeys(site for cell in cells for site in cell.place.sites)
    _, slopes = gradients_at(model, [pair.clean], [pair.seed], sites, lambda actions: metric(actions[0]))
    roles = roles_of_tokens(model, pair.clean)
    masks = [mask_of(roles[cell.place.stream], cell.place.stream, cell.role) for cell in cells]
    return sum_over_cells(own, source, [slopes], cells, masks)


def _number(metric: Slope, actions: NDArray[np.float32]) -> float:
    import torch

    return float(metric(torch.from_numpy(actions)))


def _row(cell: Cell, moved: NDArray[np.float64], exact: Sweep, anchors: Sequence[Cell]) -> AttributionEffect:
    """Estimate and exact effect of one cell, before it has a rank. moved: (E,) estimated per pair."""
    is_anchor = cell in anchors
    at = anchors.index(cell) if is_anchor else 0
    is_shown = exact.source_p < SIGNIFICANCE
    estimate = share_of_whole(moved, exact.whole, exact.groups, DRAWS) if is_shown else None
    return AttributionEffect(
        category="",
        place=cell.place.name,
        role=cell.role,
        is_anchor=is_anchor,
        is_drawn=False,
        n_episodes=exact.clean.size,
        n_groups=np.unique(exact.groups).size,
        **share_fields("estimate", estimate),
        **share_fields("exact", exact.shares[at] if is_anchor else None),
        p_fwe=float(exact.table["p_fwe"][at]) if is_anchor else None,
        rank=None,
        finding="n/a",
    )


def _columns(
    name: str, shares: Sequence[tuple[float | None, tuple[float, float] | None]]
) -> dict[str, list[float]]:
    """A share and its interval as columns."""
    limits = [(np.nan, np.nan) if ends is None else ends for _, ends in shares]
    return {
        name: [np.nan if value is None else value for value, _ in shares],
        f"{name}_low": [low for low, _ in limits],
        f"{name}_high": [high for _, high in limits],
    }
