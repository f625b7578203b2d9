"""Estimates of what patches would do: one backward pass for all cells of an episode."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from probe_kit.intervene.edits.sites import ALL, SiteGroup, resolve_sites
from probe_kit.intervene.kinds.attribution.effects import EVERY_BLOCK
from probe_kit.intervene.kinds.joint.cells import Cell
from probe_kit.intervene.replay.conditions import ConditionContext, ConditionResult
from probe_kit.intervene.replay.image_tokens import role_token_mask
from probe_kit.intervene.replay.session import ReplayInput, ReplaySession

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks import ActivationCache, Model, Observation

Ends = Literal["clean", "both"]
"""Where gradients are taken: at the clean images, or as the mean of those and of the swapped images."""
ENDS: tuple[Ends, ...] = get_args(Ends)


@dataclass(frozen=True)
class EpisodeEstimates:
    """Of one episode: metres by which the image swap moves the action, and (C,) metres estimated per cell."""

    category: str
    whole: float
    by_cell: NDArray[np.float64]


@dataclass(frozen=True)
class Estimated:
    """No inference: the clean action, and by how much an estimate says that patching a cell moves it.

    by_row: metres by the row of the run's episodes.
    """

    name: str
    by_row: Mapping[int, float] = field(repr=False)

    def play(self, context: ConditionContext) -> ConditionResult:
        """Nothing is played."""
        return ConditionResult(context.clean, estimated=self.by_row[context.replay_input.row])


def estimate_patches(
    session: ReplaySession, replay_input: ReplayInput, cells: Sequence[Cell], ends: Ends
) -> EpisodeEstimates:
    """Σ (source − clean) · ∂ lateral displacement / ∂ activation, over the tokens and features of every cell.

    As in attribution patching (Syed et al. 2023, https://arxiv.org/abs/2310.10348). Two inferences, and one with a
    backward pass; two of these for both ends.
    """
    from probe_kit.hooks import capture, gradients_at

    sites = tuple(dict.fromkeys(site for cell in cells for site in cell.place.sites))
    captured: list[tuple[float, ActivationCache]] = []
    for seen in (replay_input.seen, replay_input.swapped):
        with capture(session.policy, sites) as cache:
            chunk = session.act(seen, replay_input.seed)
        captured.append((session.lateral_displacement(chunk, replay_input.seen), cache))
    (clean, own), (swapped, source) = captured

    def slopes(seen: "Observation") -> "ActivationCache":
        seeds = [replay_input.seed]
        return gradients_at(
            session.policy, [seen], seeds, sites, lambda chunks: session.lateral_motion(chunks[0])
        )[1]

    taken = [slopes(seen) for seen in (replay_input.seen, replay_input.swapped)[: 1 + (ends == "both")]]
    memo: dict[Any, Any] = {}
    masks = [role_token_mask(session.policy, replay_input, cell.place.stream, cell.role, memo) for cell in cells]
    return EpisodeEstimates(
        replay_input.category, swapped - clean, sum_over_cells(own, source, taken, cells, masks)
    )


def sum_over_cells(
    own: "ActivationCache",
    source: "ActivationCache",
    slopes: "Sequence[ActivationCache]",
    cells: Sequence[Cell],
    masks: Sequence[NDArray[np.bool_]],
) -> NDArray[np.float64]:
    """(C,) Σ (source − own) · slope over the tokens and features of every cell, in one inference.

    slopes: the gradients at the same sites, of which the mean is taken. masks: (T,) the tokens of every cell.
    """
    sites = dict.fromkeys(site for cell in cells for site in cell.place.sites)
    products = {
        site: (source[site].float() - own[site].float())[0] * sum(one[site][0] for one in slopes) / len(slopes)
        for site in sites
    }
    return np.array(
        [
            sum(float(_of_head(products[site], cell.place)[tokens].sum()) for site in cell.place.sites)
            for cell, tokens in zip(cells, masks, strict=True)
        ]
    )


def complete_cuts(model: "Model", places: Sequence[SiteGroup]) -> list[Cell]:
    """The anchors of a screen: all of `kv`, and all tokens of each layer of the backbone in which a place lies."""
    streams = {name: stream for name, stream in model.streams.items() if stream.part == "backbone"}
    layers = [f"{place.stream}.{place.sites[0].layer:02d}" for place in places if place.stream in streams]
    whole = [place for name in dict.fromkeys(layers) for place in resolve_sites(name, model)]
    if model.prompt_kv is not None:
        blocks = resolve_sites(EVERY_BLOCK, model)
        whole.insert(0, SiteGroup(EVERY_BLOCK, tuple(site for block in blocks for site in block.sites)))
    elif not whole:
        whole = resolve_sites(f"{next(iter(streams))}.00", model)
    return [Cell(place, ALL) for place in whole]


def _of_head(product: "Tensor", place: SiteGroup) -> NDArray[np.float64]:
    """(T, D) of all features, or of those of the place's head."""
    if place.head is not None:
        width = product.shape[-1] // place.heads
        product = product[:, place.head * width : (place.head + 1) * width]
    features: NDArray[np.float64] = product.double().cpu().numpy()
    return features


def shares_by_category(found: Sequence[EpisodeEstimates]) -> dict[str, NDArray[np.float64]]:
    """By category, (C,) each cell's estimate as a share of the image swap; zeros where that does nothing."""
    shares = {}
    for category in dict.fromkeys(one.category for one in found):
        own = [one for one in found if one.category == category]
        total = sum(one.whole**2 for one in own)
        moved = sum((one.whole * one.by_cell for one in own), np.zeros_like(own[0].by_cell))
        shares[category] = moved / total if total else np.zeros_like(moved)
    return shares
