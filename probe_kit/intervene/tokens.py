"""The tokens of a role in one inference, tiles of the picture among them, and the places that a token sees.

Tiles are roles of a pair's picture. Halves of the picture are not tiles, because the camera looks from aside. The
renderer gives the pixels of a tile. The policy itself shows which patches see it, by its own crop and resize. They
are those whose embeddings change when just those pixels change, before any patch attends to another.
"""

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import EmptyRoleError, UsageError
from probe_kit.extract.sources.inputs import PICTURE, picture_of, with_pictures
from probe_kit.hooks.capturing.edits import TokenSelection
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.pairs import Given, Pair
from probe_kit.intervene.places import ALL, TILES, positions_of

if TYPE_CHECKING:
    from probe_kit.hooks import Model, Policy, Roles

ENOUGH = 0.1
"""Share of the largest change of any patch by which a patch of the tile changes; less is the filter's blur."""
HALF, NEARLY = 0.5, 0.9
"""Two limits by which the bands of a token are found.

A band counts for a token if it changes it by HALF of what the token's strongest band does, and by NEARLY as much
as, in such shares, the token that it changes most. So the blur of a resizing filter does not widen a token's box.
"""
BANDS = 32
"""Number of bands of rows, and of columns, in which a token is searched."""
ANSWERS_NOTHING = "{} answers no questions: give it an observation"


def roles_of_tokens(model: "Model", model_input: Given) -> "dict[str, Roles]":
    """Return by stream the roles of its tokens in one inference, those of `kv` among them."""
    from probe_kit.hooks import AnswerModel

    if isinstance(model_input, Observation):
        rows = model.token_roles([model_input])
    elif isinstance(model, AnswerModel):
        rows = model.asked_roles([model_input])
    else:
        raise UsageError(ANSWERS_NOTHING.format(model.card.family))
    return {name: roles[0] for name, roles in rows.items()}


def mask_of(roles: "Roles", stream: str, role: str) -> NDArray[np.bool_]:
    """Return (T,) the tokens that have the role `role`, or are at positions such as `7-11`.

    Raises:
        EmptyRoleError: If there is none.
    """
    if (positions := positions_of(role)) is not None:
        first, last = positions
        if not first <= last < len(roles):
            raise EmptyRoleError(f"{stream} has no positions {role}; it has 0 to {len(roles) - 1}")
        return (first <= np.arange(len(roles))) & (np.arange(len(roles)) <= last)
    mask = roles.valid if role == ALL else roles.mask(role)
    if not mask.any():
        names = ", ".join(dict.fromkeys(span.role for span in roles.spans))
        raise EmptyRoleError(f"no token of {stream} has the role {role!r}; there are {names}")
    return np.asarray(mask, bool)


def token_mask(model: "Model", model_input: Given, stream: str, role: str) -> NDArray[np.bool_]:
    """Return (T,) the tokens of a stream that have the role `role`.

    Raises:
        EmptyRoleError: If there is none.
    """
    return mask_of(roles_of_tokens(model, model_input)[stream], stream, role)


class PairTokens:
    """The tokens of a pair's clean inference by role, tiles among the roles.

    All conditions of a pair share one of these. So the model determines only once the role of every token, and the
    patches of the picture that see each tile.
    """

    def __init__(self, model: "Model", pair: Pair) -> None:
        self.model, self.pair = model, pair
        self._masks: dict[tuple[str, str], NDArray[np.bool_]] = {}
        self._selections: dict[tuple[str, str], TokenSelection] = {}
        self._on_tile: dict[str, NDArray[np.bool_]] = {}

    def mask(self, stream: str, role: str) -> NDArray[np.bool_]:
        """Return (T,) the tokens of a stream that have the role `role`.

        Raises:
            EmptyRoleError: If there is none.
            UnsupportedInterventionError: For a tile and a family that does not say which token sees what.
        """
        if (stream, role) not in self._masks:
            declared = self.model.role_names.get(self.model.tokens_of(stream), ())
            # A family's own role of that name, a camera called left, comes before the tile.
            is_tile = role in TILES and role not in declared and bool(self.pair.tiles)
            mask = self._tile_mask(stream, role) if is_tile else mask_of(self._roles[stream], stream, role)
            self._masks[stream, role] = mask
        return self._masks[stream, role]

    def selection(self, stream: str, role: str) -> TokenSelection:
        """Return the places of the tokens of `mask`, in the form that edits take."""
        if (stream, role) not in self._selections:
            selection = TokenSelection.of(self.mask(stream, role), self.model.card.device)
            self._selections[stream, role] = selection
        return self._selections[stream, role]

    def _tile_mask(self, stream: str, role: str) -> NDArray[np.bool_]:
        policy: Policy = self.model  # type: ignore[assignment]  # only observations have tiles
        assert isinstance(self.pair.clean, Observation)
        policy.interventions.check("tiles", policy.card.family)
        images = mask_of(self._roles[stream], stream, f"image.{policy.card.cameras[0]}")
        if role not in self._on_tile:
            pixels = self.pair.tiles[TILES[role]]
            self._on_tile[role] = tokens_overlapping(policy, self.pair.clean, pixels, self._patches)
        mask = np.zeros_like(images)
        mask[np.flatnonzero(images)[self._on_tile[role]]] = True
        if not mask.any():
            raise EmptyRoleError(f"no patch of {self.pair.episode} sees the {TILES[role]} tile")
        return mask

    @cached_property
    def _roles(self) -> "dict[str, Roles]":
        return roles_of_tokens(self.model, self.pair.clean)

    @cached_property
    def _patches(self) -> NDArray[np.float32]:
        policy: Policy = self.model  # type: ignore[assignment]
        assert isinstance(self.pair.clean, Observation)
        return patch_embeddings(policy, self.pair.clean, policy.card.cameras[0])


def tokens_overlapping(
    policy: "Policy",
    observation: Observation,
    pixels: NDArray[np.bool_],
    before: NDArray[np.float32] | None = None,
) -> NDArray[np.bool_]:
    """Return (tokens of the picture,) whether each comes from patches that see any of some pixels (H, W).

    The pixels are of the first camera's picture, in which the renderer gives the places of tiles.

    Args:
        policy: Policy with a vision tower.
        observation: Observation with the picture.
        pixels: (H, W) mask of the pixels.
        before: Result of `patch_embeddings` on `observation`; None to compute it.
    """
    if not pixels.any():
        return np.zeros(int(policy.patch_order().max()) + 1, bool)
    camera = policy.card.cameras[0]
    before = patch_embeddings(policy, observation, camera) if before is None else before
    moved = _patch_changes(policy, observation, pixels, before, camera)
    return _by_token(policy, moved > ENOUGH * moved.max())


def _patch_changes(
    policy: "Policy",
    observation: Observation,
    pixels: NDArray[np.bool_],
    before: NDArray[np.float32],
    camera: str,
) -> NDArray[np.float32]:
    """Return (V,) by how much the patches' embeddings change with some pixels (H, W) of a camera's picture."""
    picture = picture_of(observation, camera)
    # Every pixel changes by at least half of what it can.
    inverted = np.where(picture < 128, 255, 0)
    turned = np.where(pixels[..., None], inverted, picture).astype(np.uint8)
    changed = with_pictures(observation, f"{PICTURE}.{camera}", lambda _: turned)
    after = patch_embeddings(policy, changed, camera)
    return np.asarray(np.linalg.norm(after - before, axis=-1))


def _by_token[T: np.generic](policy: "Policy", values: NDArray[T]) -> NDArray[T]:
    """Return (tokens of the picture,) the largest of the values (V,) of their patches; patches may be dropped."""
    order = policy.patch_order()
    largest = np.zeros(int(order.max()) + 1, values.dtype)
    np.maximum.at(largest, order[order >= 0], values[order >= 0])
    return largest


def shown_cameras(policy: "Policy", stream: str) -> tuple[str, ...]:
    """Return the cameras whose pictures have tokens in a stream, in the order of the pictures."""
    roles = policy.role_names[policy.tokens_of(stream)]
    return tuple(camera for camera in policy.card.cameras if f"image.{camera}" in roles)


def token_boxes(policy: "Policy", observation: Observation, camera: str) -> NDArray[np.float32]:
    """Return (tokens of a camera's picture, 4) the box that each sees: left, top, right, bottom, as shares of it.

    Boxes are measured by changing a band of rows, then of columns, at a time. So crops, padding and turns of the
    policy's own preprocessing are included. NaN for a token that no pixel moves. It takes 2 × `BANDS` + 1
    inferences.
    """
    before, ends = patch_embeddings(policy, observation, camera), []
    height, width, _ = picture_of(observation, camera).shape
    for axis, size in ((1, width), (0, height)):
        bands = min(BANDS, size)
        changes = []
        for band in range(bands):
            pixels = np.zeros((height, width), bool)
            inside = slice(band * size // bands, (band + 1) * size // bands)
            pixels[(slice(None), inside) if axis == 1 else inside] = True
            changes.append(_by_token(policy, _patch_changes(policy, observation, pixels, before, camera)))
        moved = np.array(changes)
        most = moved.max(axis=0)
        looks = most > ENOUGH * most.max()
        # Shares of each token's own largest change: filters blur a band into the neighbours of its token.
        relative = np.where(looks, moved / np.where(looks, most, 1.0), 0.0)
        sees = (relative > HALF) & (relative >= NEARLY * relative.max(axis=1, keepdims=True))
        first, last = sees.argmax(axis=0) / bands, 1 - sees[::-1].argmax(axis=0) / bands
        ends.append(np.where(sees.any(axis=0), [first, last], np.nan))
    (x_first, x_last), (y_first, y_last) = ends
    return np.stack([x_first, y_first, x_last, y_last], axis=1).astype(np.float32)


def patch_embeddings(policy: "Policy", observation: Observation, camera: str) -> NDArray[np.float32]:
    """Return a camera's patches (V, D) as they enter the first block of the vision tower."""
    from probe_kit.hooks import capture

    # A tower that sees one picture at a time has the cameras as its iterations, in their order.
    entries = [site for site in policy.every_stream()["vision"].sites() if site.layer == 0]
    site = entries[policy.card.cameras.index(camera) if len(entries) > 1 else 0]
    with capture(policy, [site]) as activations:
        policy.act([observation], [0])
    embeddings: NDArray[np.float32] = activations[site][0].float().cpu().numpy()
    return embeddings
