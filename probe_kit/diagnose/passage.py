"""The way of an input to the action: at which sites two inferences differ, and which carry the change on.

The clean and the donor inference have the same seed and differ in one input. At every site of the streams that are
stored, and of `kv`, two numbers are measured: how much the activations differ, and how much of the change of the
action follows when only this site is patched from the donor into the clean inference.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from probe_kit.diagnose.importance import ActionScale
from probe_kit.diagnose.results import LIKE_NONE, SitePassage
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.intervene.pairs import Chunk, Given, Pair
from probe_kit.intervene.patching.patch import Cell, patched
from probe_kit.intervene.places import ALL, SiteGroup, resolve_sites

if TYPE_CHECKING:
    from probe_kit.hooks import ActivationCache, Model
    from probe_kit.intervene.sessions.session import ReplaySession


def places_of(model: "Model") -> list[SiteGroup]:
    """Every layer of every stored stream, and what the backbone hands over, in the order of the network."""
    streams = list(model.streams)
    if model.prompt_kv is not None:
        streams.insert(1, KV_STREAM)
    return [group for stream in streams for group in resolve_sites(f"{stream}.*", model)]


def measure_passage(
    session: "ReplaySession", pairs: Sequence[Pair], scale: ActionScale
) -> tuple[SitePassage, ...]:
    """Both numbers at every site, over pairs of equally many tokens; two inferences per pair, and one per site.

    scale: of the session's actions. Raises what `capture` and `patched` raise.
    """
    model, places = session.policy, places_of(session.policy)
    differences = np.zeros((len(pairs), len(places)))
    moved, squares = np.zeros((len(pairs), len(places))), np.zeros(len(pairs))
    for row, pair in enumerate(pairs):
        clean, before = _captured(session, pair.clean, pair.seed, places)
        donated, donor = _captured(session, pair.source, pair.seed, places)
        change = scale.changes(donated[None], clean[None])[0]
        squares[row] = change @ change
        memo: dict[object, object] = {}
        for column, group in enumerate(places):
            differences[row, column] = _relative_difference(group, before, donor)
            # Elsewhere the patch would put in what is there already: an inference saved, and a share of 0.
            if squares[row] and differences[row, column] > LIKE_NONE:
                with patched(model, pair, [Cell(group, ALL)], donor, memo=memo):
                    edited = session.act(pair.clean, pair.seed)
                moved[row, column] = scale.changes(edited[None], clean[None])[0] @ change
    # A ratio of sums: pairs whose action hardly changes have little weight.
    shares = moved.sum(axis=0) / squares.sum() if squares.any() else np.full(len(places), np.nan)
    return tuple(
        SitePassage(group.name, float(difference), float(share))
        for group, difference, share in zip(places, differences.mean(axis=0), shares, strict=True)
    )


def _captured(
    session: "ReplaySession", observation: Given, seed: int, places: Sequence[SiteGroup]
) -> "tuple[Chunk, ActivationCache]":
    """The actions of one inference in the session's units, which of recordings are the checkpoint's own."""
    from probe_kit.hooks import capture

    with capture(session.policy, [site for group in places for site in group.sites]) as cache:
        chunk = session.act(observation, seed)
    return chunk, cache


def _relative_difference(group: SiteGroup, before: "ActivationCache", after: "ActivationCache") -> float:
    """Norm of the difference over all tokens and iterations of a place, relative to the norm before."""
    difference = norm = 0.0
    for site in group.sites:
        clean, donated = before[site].float(), after[site].float()
        difference += float((donated - clean).square().sum())
        norm += float(clean.square().sum())
    return float(np.sqrt(difference / norm)) if norm else 0.0
