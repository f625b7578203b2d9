"""A screen by gradients over pairs: estimates for all cells, and exact patches of the anchors that test them.

One backward pass gives the estimates of all cells of a pair. This is attribution patching (Syed et al. 2023,
https://arxiv.org/abs/2310.10348).
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from probe_kit._tables.numbers import number
from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.exchange import Exchange, SwapShare, share_columns, share_fields
from probe_kit.intervene.outcomes import Effect
from probe_kit.intervene.pairs import Given, Pair
from probe_kit.intervene.patching.patch import Cell, infer, sites_of_cells
from probe_kit.intervene.patching.sweep import sweep_cells
from probe_kit.intervene.places import ALL, RESIDUAL, PlaceName, SiteGroup, resolve_sites
from probe_kit.intervene.tokens import PairTokens

if TYPE_CHECKING:
    import pandas as pd
    from torch import Tensor

    from probe_kit.hooks import ActivationCache, Model, Policy

CellName = tuple[str, str]
"""Place and role."""
Ends = Literal["clean", "both"]
"""Inputs at which gradients are taken: the clean input, or the mean of that and of the source."""
Slope = Callable[["Tensor"], "Tensor"]
"""Function from actions (chunk, D) to a number with a graph, such as metres to the left."""
EVERY_BLOCK = f"{KV_STREAM}.*"
"""Name of the anchor that is all of `kv`."""
AGREEMENT = 3.0
"""Factor within which an anchor's estimate must lie of its exact effect.

It is a choice: orders survive it.
"""
LOCALISATION_SHARE = 0.5
"""Share of the whole effect from which on a place is called localised; for sets it is `exchange.CARRIES`."""
FIRST = 3
"""Number of cells that a sentence names."""


@dataclass(frozen=True, kw_only=True)
class AttributionEffect(Effect):
    """One cell in one category.

    Shares and their intervals are None where the swap itself is not significant.

    Attributes:
        sites: Name of the place.
        role: Role of the tokens.
        is_anchor: Whether it is a complete cut, patched exactly to test the screen.
        is_drawn: Whether it was patched exactly although its estimate was not among the largest.
        estimate: Share of the image swap by gradients.
        estimate_ci: The 95 % interval of `estimate`, by groups.
        exact: Share of the image swap with these tokens patched; None too where no exact patch was made.
        exact_ci: The 95 % interval of `exact`, by groups.
        p_fwe: Family-wise p-value of the exact patch, one-sided, max-T over those of the category; None without an
            exact patch.
        rank: Rank by estimate among the cells of its kind, 1 for the largest; None in a void screen.
        finding: Finding on the category's screen: `anchored`, `void`, or `n/a` where no anchor carries the effect.
        key: Key of the intervention.
    """

    sites: str
    role: str
    is_anchor: bool
    is_drawn: bool
    n_episodes: int
    n_groups: int
    estimate: float | None
    estimate_ci: tuple[float, float] | None
    exact: float | None
    exact_ci: tuple[float, float] | None
    p_fwe: float | None
    rank: int | None = None
    finding: str = "n/a"
    key: str = ""

    @property
    def name(self) -> str:
        """The place and role in words."""
        return f"{self.sites} {self.role}"

    @property
    def kind(self) -> str:
        """The kind of cells among which it is ranked; empty for an anchor."""
        return "" if self.is_anchor else kind_of_place(self.sites)


# -- estimates -----------------------------------------------------------------------------------------------


def estimate_patches(
    model: "Policy",
    pair: Pair,
    cells: Sequence[Cell],
    slope: Slope,
    ends: Ends = "clean",
    act: Callable[[Given, int], Any] | None = None,
) -> tuple[Any, Any, NDArray[np.float64]]:
    """Return the outputs of the clean and the source's inference, and (C,) the estimate of every cell's patch.

    The estimate is Σ (source − clean) · ∂ slope / ∂ activation, over the tokens and features of the cell. It takes
    two inferences, and one with a backward pass; two of these for both ends.

    Args:
        model: Policy with gradients.
        pair: Pair of observations.
        cells: The C cells.
        slope: Function from actions to a number with a graph.
        ends: Inputs at which gradients are taken.
        act: Function that makes an inference; None for `infer`.
    """
    from probe_kit.hooks import capture, gradients_at

    act = act or partial(infer, model)
    sites = sites_of_cells(cells)
    captured = []
    for model_input in (pair.clean, pair.source):
        with capture(model, sites) as cache:
            captured.append((act(model_input, pair.seed), cache))
    (clean, activations), (moved, source) = captured
    # The clean end alone gives the tangent there; the mean of both ends is the trapezium rule between them.
    slopes = []
    for model_input in (pair.clean, pair.source)[: 1 + (ends == "both")]:
        assert isinstance(model_input, Observation)
        slopes.append(gradients_at(model, [model_input], [pair.seed], sites, lambda chunks: slope(chunks[0]))[1])
    tokens = PairTokens(model, pair)
    masks = [tokens.mask(cell.site_group.stream, cell.role) for cell in cells]
    return clean, moved, sum_over_cells(activations, source, slopes, cells, masks)


def sum_over_cells(
    clean: "ActivationCache",
    source: "ActivationCache",
    slopes: "Sequence[ActivationCache]",
    cells: Sequence[Cell],
    masks: Sequence[NDArray[np.bool_]],
) -> NDArray[np.float64]:
    """Return (C,) Σ (source − clean) · slope over the tokens and features of every cell, in one inference.

    Args:
        clean: Activations of the clean inference, at the sites of the cells.
        source: Activations of the source's inference, at the same sites.
        slopes: Gradients at the same sites, of which the mean is taken.
        cells: The C cells.
        masks: (T,) tokens of every cell.
    """
    products = {
        site: (source[site].float() - clean[site].float())[0]
        * sum(gradients[site][0] for gradients in slopes)
        / len(slopes)
        for site in sites_of_cells(cells)
    }
    return np.array(
        [
            sum(
                float(_product_of_head(products[site], cell.site_group)[tokens].sum())
                for site in cell.site_group.sites
            )
            for cell, tokens in zip(cells, masks, strict=True)
        ]
    )


def _product_of_head(product: "Tensor", site_group: SiteGroup) -> NDArray[np.float64]:
    """Return the product (T, D) of all features, or of those of the place's head."""
    if site_group.head is not None:
        width = product.shape[-1] // site_group.heads
        product = product[:, site_group.head * width : (site_group.head + 1) * width]
    features: NDArray[np.float64] = product.double().cpu().numpy()
    return features


def complete_cuts(model: "Model", places: Sequence[SiteGroup]) -> list[Cell]:
    """Return the anchors of a screen: all of `kv`, and all tokens of each backbone layer in which a place lies."""
    streams = {name: stream for name, stream in model.streams.items() if stream.part == "backbone"}
    layers = [
        f"{site_group.stream}.{site_group.sites[0].layer:02d}"
        for site_group in places
        if site_group.stream in streams
    ]
    cuts = [site_group for name in dict.fromkeys(layers) for site_group in resolve_sites(name, model)]
    if model.prompt_kv is not None:
        blocks = resolve_sites(EVERY_BLOCK, model)
        cuts.insert(0, SiteGroup(EVERY_BLOCK, tuple(site for block in blocks for site in block.sites)))
    elif not cuts:  # neither `kv` nor a place in the backbone: its embeddings are a complete cut too
        cuts = resolve_sites(f"{next(iter(streams))}.00", model)
    return [Cell(site_group, ALL) for site_group in cuts]


# -- order ---------------------------------------------------------------------------------------------------


def worst_anchor(rows: Sequence[AttributionEffect]) -> AttributionEffect | None:
    """Return the anchor with the worst estimate, of those that carry half of the effect; None if none does."""
    carrying = [row for row in rows if row.is_anchor and (row.exact or 0.0) >= LOCALISATION_SHARE]
    return min(carrying, key=_agreement, default=None)


def _agreement(row: AttributionEffect) -> float:
    """Return 1 for an exact estimate, towards 0 for one that is too small, too large or of the other sign."""
    ratio = (row.estimate or 0.0) / (row.exact or 1.0)
    return 0.0 if ratio <= 0 else min(ratio, 1 / ratio)


def order_cells(rows: Sequence[AttributionEffect]) -> list[AttributionEffect]:
    """Return rows of one category with rank and finding: the anchors, then the cells of each kind."""
    worst = worst_anchor(rows)
    finding = "n/a" if worst is None else "anchored" if _agreement(worst) * AGREEMENT >= 1 else "void"
    rows = [replace(row, finding=finding) for row in rows]
    ordered = [row for row in rows if row.is_anchor]
    for kind in dict.fromkeys(row.kind for row in rows if not row.is_anchor):
        cells = [row for row in rows if row.kind == kind]
        if finding == "anchored":
            cells = sorted(cells, key=lambda row: -abs(row.estimate or 0.0))
            cells = [replace(row, rank=at + 1) for at, row in enumerate(cells)]
        ordered += cells
    return ordered


def screen_rows(
    exchange: Exchange,
    estimates: Mapping[CellName, NDArray[np.float64]],
    exact: Mapping[CellName, NDArray[np.float64]],
    anchors: Collection[CellName],
    drawn: Collection[CellName] = (),
    category: str = "",
) -> list[AttributionEffect]:
    """Return the effects of cells of one category, in the order of `order_cells`.

    Args:
        exchange: Effect of the source.
        estimates: By cell, (E,) how far its patch moves the output by gradients.
        exact: By cell that was patched exactly, (E,) how far the patch moved the output.
        anchors: Cells that are a complete cut.
        drawn: Cells that were chosen at random.
        category: Name of the category; empty outside of runs.
    """
    _, _, p_fwe = exchange.test(np.array(list(exact.values())))
    p_of = dict(zip(exact, map(float, p_fwe), strict=True))
    rows = [
        AttributionEffect(
            category=category,
            sites=cell[0],
            role=cell[1],
            is_anchor=cell in anchors,
            is_drawn=cell in drawn,
            n_episodes=exchange.clean.size,
            n_groups=np.unique(exchange.groups).size,
            **share_fields("estimate", exchange.share(moved)),
            **share_fields("exact", exchange.share(exact[cell]) if cell in exact else None),
            p_fwe=p_of.get(cell),
        )
        for cell, moved in estimates.items()
    ]
    return order_cells(rows)


def kind_of_place(name: str) -> str:
    """Return the kind of a place, of places that can be compared with each other.

    Examples are `kv`, `backbone`, `backbone heads`, `expert iterations`.
    """
    parsed = PlaceName.parse(name)
    qualifiers = [parsed.quantity * (parsed.quantity != RESIDUAL), "iterations" * (parsed.iterations is not None)]
    return " ".join(filter(None, (parsed.stream, *qualifiers)))


def describe_screen(rows: Sequence[AttributionEffect]) -> str:
    """Return the test on the anchors, and the first cells of each kind unless the screen is void.

    The rows are of one category.
    """
    worst = worst_anchor(rows)
    if worst is None:
        return "no anchor carries the effect, so that there is no order"
    if worst.finding == "void":
        return f"{describe_void(rows)}; no order is shown"
    kinds = dict.fromkeys(row.kind for row in rows)
    firsts = [_first([row for row in rows if row.kind == kind]) for kind in kinds]
    drawn = [abs(row.exact) for row in rows if row.is_drawn and row.exact is not None]
    missed = [f"of {len(drawn)} drawn cells the largest exact effect is {max(drawn):.2f}"] if drawn else []
    return "; ".join([_compare_orders(worst), *filter(None, firsts), *missed])


def describe_void(rows: Sequence[AttributionEffect]) -> str:
    """Return why a screen is void."""
    worst = worst_anchor(rows)
    assert worst is not None
    return f"screen void: {_compare_orders(worst)}"


def _first(rows: Sequence[AttributionEffect]) -> str:
    """Return the largest estimates of one kind; empty for the anchors, which have no rank."""
    first = [
        f"{row.name} {number(row.estimate)}{'' if row.exact is None else f', exact {number(row.exact)}'}"
        for row in rows
        if row.rank is not None and row.rank <= FIRST
    ]
    return f"first of {rows[0].kind}: {', '.join(first)}" if first else ""


def _compare_orders(anchor: AttributionEffect) -> str:
    return f"gradients give {number(anchor.estimate)} where the patch gives {number(anchor.exact)} ({anchor.name})"


# -- in Python -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Screen:
    """Estimates by gradients of each cell, and whether they can be trusted.

    Attributes:
        rows: The anchors, then the cells of each kind by rank; in a void screen in the order in which they were
            given.
        cells: Cells by name.
    """

    rows: tuple[AttributionEffect, ...]
    cells: Mapping[str, Cell]

    @property
    def finding(self) -> str:
        """The finding: `anchored`, `void`, or `n/a` where no anchor carries the effect of the source."""
        return self.rows[0].finding

    @property
    def anchor(self) -> AttributionEffect | None:
        """The complete cut with the worst estimate, of those that carry the effect; None without one."""
        return worst_anchor(self.rows)

    @cached_property
    def table(self) -> "pd.DataFrame":
        """The screen as one row per anchor and cell.

        Columns are cells; kind, empty for an anchor; rank within the kind, NaN unless the screen is anchored;
        estimate with estimate_low, estimate_high; exact with exact_low, exact_high, of anchors alone. Shares are
        NaN where the source itself is not significant.
        """
        import pandas as pd

        return pd.DataFrame(
            [
                {
                    "cells": row.name,
                    "kind": row.kind,
                    "rank": np.nan if row.rank is None else row.rank,
                    **share_columns("estimate", _share(row.estimate, row.estimate_ci)),
                    **share_columns("exact", _share(row.exact, row.exact_ci)),
                }
                for row in self.rows
            ]
        )

    def choose(self, top: int = 20, drawn: int = 20, seed: int = 0) -> tuple[tuple[Cell, ...], tuple[Cell, ...]]:
        """Return cells for exact patches: of each kind the `top` largest estimates, and `drawn` of all others.

        The largest exact effect of the drawn ones bounds the effects that the screen missed.

        Raises:
            UsageError: For a screen that is not anchored: it has no order.
        """
        if self.finding != "anchored":
            raise UsageError(f"{self}; patch cells exactly with sweep_cells, or sets with find_minimal_cells")
        ranked = [row for row in self.rows if row.rank is not None]
        largest = [row.name for row in ranked if (row.rank or 0) <= top]
        remaining = [row.name for row in ranked if (row.rank or 0) > top]
        draw = np.random.default_rng(derive_seed("screen", seed)).permutation(len(remaining))[:drawn]
        names = largest, [remaining[at] for at in sorted(draw.tolist())]
        first, second = (tuple(self.cells[name] for name in part) for part in names)
        return first, second

    def __str__(self) -> str:
        return describe_screen(self.rows)


def attribute_cells(model: "Policy", pairs: Sequence[Pair], cells: Sequence[Cell], metric: Slope) -> Screen:
    """Estimate the effect of a patch of every cell, by attribution patching, and test the estimates on anchors.

    Anchors are patched exactly: all of `kv`, and all tokens of each layer of the backbone with a cell. If one that
    carries the effect is missed by more than a factor of 3, the screen is void. The cost per pair is two
    inferences, one with a backward pass, and one per anchor.

    Args:
        model: Policy with gradients.
        pairs: Pairs of observations.
        cells: Cells to estimate.
        metric: Function from actions (chunk, D) to a number with a graph, such as `session.lateral_motion`.

    Raises:
        UnsupportedInterventionError: Before any inference, for a family without gradients.
        UsageError: Without pairs or cells, or for pairs of questions.
    """
    import torch

    screened = tuple(dict.fromkeys(cells))
    model.interventions.check("gradients", model.card.family)
    if not pairs or not screened:
        raise UsageError(f"a screen of {len(screened)} cells in {len(pairs)} pairs; give at least one of both")
    if not all(isinstance(pair.clean, Observation) for pair in pairs):
        raise UsageError("gradients are of actions; give pairs of observations, not of questions")
    anchors = complete_cuts(model, list(dict.fromkeys(cell.site_group for cell in screened)))
    every = (*anchors, *(cell for cell in screened if cell not in anchors))
    estimates = np.array([estimate_patches(model, pair, every, metric)[2] for pair in pairs]).T
    exact = sweep_cells(model, pairs, anchors, lambda actions, _: float(metric(torch.from_numpy(actions))))
    by_cell = {(cell.site_group.name, cell.role): moved for cell, moved in zip(every, estimates, strict=True)}
    of_anchors = dict(zip(by_cell, exact.patched - exact.clean, strict=False))  # anchors come first
    rows = screen_rows(exact.exchange, by_cell, of_anchors, of_anchors)
    return Screen(tuple(rows), {str(cell): cell for cell in every})


def _share(value: float | None, limits: tuple[float, float] | None) -> SwapShare | None:
    return None if value is None or limits is None else SwapShare(value, *limits)
