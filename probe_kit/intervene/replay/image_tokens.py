"""Tokens by tile: the picture's tokens that see the left or the right one of the two pictures.

Halves of the picture are not tiles: the camera looks from aside. Where a tile is seen says the renderer; which
patches see it says the policy itself, by its own crop and resize: the embeddings that change when just those
pixels do, before any patch looks at another.
"""

from collections.abc import Mapping, MutableMapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import EmptyRoleError
from probe_kit.hooks.capturing.token_edits import TokenSelection
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.edits.sites import TILE_ROLES, token_mask
from probe_kit.suite.items import Side

if TYPE_CHECKING:
    from probe_kit.hooks import Policy
    from probe_kit.intervene.replay.session import ReplayInput

TILES: Mapping[str, Side] = dict(zip(TILE_ROLES, ("left", "right"), strict=True))
"""Roles by tile, and the tile."""
IMAGE = "image"
PATCHES = "patches"
"""Under which an input keeps its own, which all tiles are compared with."""
ENOUGH = 0.1
"""Share of the largest change of any patch by which a patch of the tile changes; less is the filter's blur."""


def role_token_mask(
    policy: "Policy", replay_input: "ReplayInput", stream: str, role: str, memo: MutableMapping[Any, Any]
) -> NDArray[np.bool_]:
    """(T,) the tokens of a stream that play `role`, tiles among the roles. memo: of one question.

    A family's own role of that name, a camera called left, comes before the tile. Raises EmptyRoleError if no
    token plays it, UnsupportedInterventionError for a family that does not say which token sees what.
    """
    declared = policy.role_names.get(policy.tokens_of(stream), ())
    if role not in TILES or role in declared:
        if (stream, role) not in memo:
            memo[stream, role] = token_mask(policy, replay_input.seen, stream, role)
        return np.asarray(memo[stream, role])
    policy.interventions.check("tiles", policy.card.family)
    images = token_mask(policy, replay_input.seen, stream, f"{IMAGE}.{policy.card.cameras[0]}")
    if role not in memo:
        if PATCHES not in memo:
            memo[PATCHES] = patch_embeddings(policy, replay_input.seen)
        memo[role] = tokens_overlapping(policy, replay_input.seen, replay_input.tiles[TILES[role]], memo[PATCHES])
    mask = np.zeros_like(images)
    mask[np.flatnonzero(images)[memo[role]]] = True
    if not mask.any():
        raise EmptyRoleError(f"no patch of {replay_input.episode_id} sees the {TILES[role]} tile")
    return mask


def role_tokens(
    policy: "Policy", replay_input: "ReplayInput", stream: str, role: str, memo: MutableMapping[Any, Any]
) -> TokenSelection:
    """As `role_token_mask`, where they are; found once per question."""
    name = stream, role, "tokens"
    if name not in memo:
        memo[name] = TokenSelection.of(
            role_token_mask(policy, replay_input, stream, role, memo), policy.card.device
        )
    found: TokenSelection = memo[name]
    return found


def tokens_overlapping(
    policy: "Policy", seen: Observation, pixels: NDArray[np.bool_], before: NDArray[np.float32] | None = None
) -> NDArray[np.bool_]:
    """(tokens of the picture,) which of them come of patches that see any of some pixels (H, W).

    before: what `patch_embeddings` gives of `seen`, if it is known.
    """
    if not pixels.any():
        return np.zeros(int(policy.patch_order().max()) + 1, bool)
    # Every pixel changes by at least half of what it can.
    turned = np.where(pixels[..., None], np.where(seen.image < 128, 255, 0), seen.image).astype(np.uint8)
    before = patch_embeddings(policy, seen) if before is None else before
    after = patch_embeddings(policy, replace(seen, image=turned))
    moved = np.linalg.norm(after - before, axis=-1)
    order = policy.patch_order()
    found = np.zeros(int(order.max()) + 1, bool)
    found[order[(moved > ENOUGH * moved.max()) & (order >= 0)]] = True
    return found


def patch_embeddings(policy: "Policy", seen: Observation) -> NDArray[np.float32]:
    """(V, D) the first camera's patches as they enter the first block of the vision tower."""
    from probe_kit.hooks import capture

    site = policy.every_stream()["vision"].sites()[0]
    with capture(policy, [site]) as tape:
        policy.act([seen], [0])
    found: NDArray[np.float32] = tape[site][0].float().cpu().numpy()
    return found
