"""Pairs of inferences, places that are changed together, and the tokens at which they are.

Tiles are roles of a pair's picture. Halves of the picture are not tiles: the camera looks from aside. The renderer
says where a tile is seen. The policy itself says which patches see it, by its own crop and resize: the embeddings
that change when just those pixels do, before any patch looks at another.
"""

import re
from collections.abc import Collection, Iterable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Union

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.text_tables import open_table
from probe_kit.errors import EmptyRoleError, UnknownSiteError, UsageError
from probe_kit.extract.sources.inputs import PICTURE, picture_of, with_pictures
from probe_kit.hooks.capturing.edits import OfOneHead, TokenEdit, TokenSelection
from probe_kit.hooks.contract.declared import Interventions
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import HEADS, KV, KV_STREAM, Site, plays
from probe_kit.intervene.outcomes import PairRow
from probe_kit.suite.items import Side

if TYPE_CHECKING:
    from probe_kit.hooks import Model, Policy, Prompt, Roles, Stream


Given = Union[Observation, "Prompt"]
"""An observation of a policy, or a question to a model that answers."""
Chunk = NDArray[np.float32]


@dataclass(frozen=True)
class Pair:
    """Two inferences with the same seed.

    clean: what is patched into. source: what activations are patched from; it must have as many tokens. toward:
    +1 or −1, the direction of the metric in which the source should move the output. group: the unit that is
    resampled and flipped, such as a couple of items; item: the unit that is averaged before; both may be empty
    for pairs that are independent of each other.

    Pairs of a run have more. row, episode, category: of the run. side: of the correct picture; None without sides.
    tiles: (H, W) where each tile is seen in the clean picture. stored: (n, D) actions of the clean inference that
    the run has, None where it does not say. step: which inference of the episode it is, or the recorded frame.
    donor: of frames without sides, the other frame of which the source has one input. donor_name: of that frame.
    control: the clean one after a change of that input that means nothing.
    """

    clean: Given
    source: Given
    seed: int = 0
    toward: int = 1
    group: str = ""
    item: str = ""
    row: int = -1
    episode: str = ""
    category: str = ""
    side: Side | None = None
    donor: Given | None = None
    donor_name: str = ""
    control: Given | None = None
    tiles: Mapping[Side, NDArray[np.bool_]] = field(default=MappingProxyType({}), repr=False)
    stored: Chunk | None = field(default=None, repr=False)
    step: int = 0


def groups_and_items(pairs: Sequence[Pair]) -> tuple[list[str], list[str]]:
    """The group and the item of every pair; a pair without one is alone in its own."""
    groups = [pair.group or f"pair {at}" for at, pair in enumerate(pairs)]
    return groups, [pair.item or f"{groups[at]}, pair {at}" for at, pair in enumerate(pairs)]


# -- tables of the user's own --------------------------------------------------------------------------------

MOST_FRAMES = 8
"""Numbers of frames that a message names."""
PAIR_COLUMNS = ("episode", "frame", "donor_episode", "donor_frame")


def read_pairs(path: Path) -> tuple[PairRow, ...]:
    """Return the rows of a table with the columns episode, frame, donor_episode, donor_frame.

    Raises UsageError.
    """
    table = open_table(path, PAIR_COLUMNS)
    if missing := [name for name in PAIR_COLUMNS if name not in table.names]:
        raise UsageError(f"{path} has no column {missing[0]!r}; expected {', '.join(PAIR_COLUMNS)}")
    rows = []
    for line, cells in table.rows(PAIR_COLUMNS):
        for column in PAIR_COLUMNS[1::2]:
            if not (text := cells[column] or "").isdecimal():
                raise UsageError(
                    f"{table.where(line, column)} is {text!r}; expected the number of a frame, from 0"
                )
        clean, frame, donor, donor_frame = (cells[name] or "" for name in PAIR_COLUMNS)
        # A recorded episode may be called by its number.
        clean, donor = (f"episode-{int(name):06d}" if name.isdecimal() else name for name in (clean, donor))
        rows.append((clean, int(frame), donor, int(donor_frame)))
    if not rows:
        raise UsageError(f"{path} names no pair; expected a line per pair")
    return tuple(rows)


def check_pairs(table: Sequence[PairRow], frames: Collection[tuple[str, int]]) -> None:
    """Raise UsageError for a row that names none of the `frames`, each an episode and a number."""
    for episode, number in (part for row in table for part in (row[:2], row[2:])):
        if (episode, number) not in frames:
            numbers = sorted(frame for name, frame in frames if name == episode)
            first = next(iter(frames), ("none", 0))[0]
            some = ", ".join(map(str, numbers[:MOST_FRAMES])) + ", …" * (len(numbers) > MOST_FRAMES)
            its = f"of that episode {some}" if numbers else f"episodes such as {first!r}"
            raise UsageError(
                f"the run has no frame {number} of {episode!r}, which the table of pairs names; it has {its}"
            )


# -- places --------------------------------------------------------------------------------------------------

TILE_ROLES = ("image.left", "image.right")
"""Roles of the patches that see one of the two pictures; see `tiles`."""
ALL = "all"
"""The role of every token but padding."""
RESIDUAL = "residual"
SEPARATOR = "|"
"""Between the parts of a condition's name, such as `backbone.02|image`."""
SHORTEST_RANGE = 3
"""Consecutive layers that are named by their first and last."""
_POSITIONS = re.compile(r"(?P<first>\d+)(-(?P<last>\d+))?")
_PATTERN = re.compile(
    r"(?P<stream>[a-z][a-z_0-9]*)\.(?P<layer>\*|\d+)(\.(?P<quantity>[a-z_]+)(\.(?P<head>\*|\d+))?)?"
    r"(@(?P<first>\d+)(-(?P<last>\d+))?)?"
)


@dataclass(frozen=True)
class PlaceName:
    """The parts of a place's name: `backbone.02`, `kv.01.values`, `backbone.02.heads.3`, `expert.03@0-4`.

    quantity: empty where it is not named: the residual stream, of `kv` keys and values. head: of the quantity
    `heads`. iterations: first and last one; None for all.
    """

    stream: str
    layer: int
    quantity: str = ""
    head: int | None = None
    iterations: tuple[int, int] | None = None

    @classmethod
    def parse(cls, name: str) -> "PlaceName":
        """Take the name of one place apart. Raises UnknownSiteError for another form."""
        match = _PATTERN.fullmatch(name)
        if match is None or "*" in name:
            raise UnknownSiteError(f"{name!r} is not the name of a place, such as backbone.02 or expert.03@0-4")
        first, last = match["first"], match["last"]
        return cls(
            match["stream"],
            int(match["layer"]),
            match["quantity"] or "",
            None if match["head"] is None else int(match["head"]),
            None if first is None else (int(first), int(last or first)),
        )

    def __str__(self) -> str:
        parts = [self.stream, f"{self.layer:02d}", self.quantity, "" if self.head is None else str(self.head)]
        name = ".".join(filter(None, parts))
        if self.iterations is None:
            return name
        first, last = self.iterations
        return f"{name}@{first}" if first == last else f"{name}@{first}-{last}"

    @property
    def is_whole_layer(self) -> bool:
        """Whether it is the stream itself in one layer, over all iterations."""
        return self.quantity in ("", RESIDUAL) and self.iterations is None

    @property
    def depth(self) -> tuple[object, ...]:
        """Return a key that sorts places of one stream: shallow before deep, a layer before its parts."""
        return self.layer, self.iterations or (0, 0), self.quantity, -1 if self.head is None else self.head


def list_places(names: Sequence[str], most: int | None = None) -> str:
    """Places, each with its role if it has one, in words: `backbone.01 to backbone.07 language, kv.02 image`.

    Three or more of one kind in consecutive layers become one range. most: how many places and ranges are named,
    by default all; the number of others follows.
    """
    ranges: list[list[tuple[PlaceName, str]]] = []
    for name in names:
        site, _, role = name.partition(" ")
        parsed = PlaceName.parse(site)
        before = ranges[-1][-1] if ranges else None
        if before is not None and (replace(before[0], layer=before[0].layer + 1), before[1]) == (parsed, role):
            ranges[-1].append((parsed, role))
        else:
            ranges.append([(parsed, role)])
    texts: list[str] = []
    for parts in ranges:
        places = [" ".join(filter(None, map(str, part))) for part in parts]
        texts += [f"{parts[0][0]} to {places[-1]}"] if len(parts) >= SHORTEST_RANGE else places
    more = f" and {len(texts) - most} more" if most is not None and len(texts) > most else ""
    return f"{', '.join(texts[:most])}{more}"


@dataclass(frozen=True)
class SiteGroup:
    """One quantity of a layer of a stream, over some of its iterations; of `kv` keys and values together.

    head: which of the `heads` heads is meant, of sites of that quantity; None for all of them.
    """

    name: str
    sites: tuple[Site, ...]
    head: int | None = None
    heads: int = 0

    @property
    def only_site(self) -> Site:
        """Its one site, where a direction can be found. Raises UnknownSiteError if it has several, or no mean."""
        if self.stream == KV_STREAM or self.sites[0].quantity != RESIDUAL:
            what = "keys and values" if self.stream == KV_STREAM else f"of the quantity {self.sites[0].quantity}"
            raise UnknownSiteError(
                f"{self.name} is {what}, of which a run stores no means, so that no direction is found; "
                "name a place of a residual stream, such as backbone.02"
            )
        if len(self.sites) != 1:
            raise UnknownSiteError(
                f"{self.name} is {len(self.sites)} sites, each with directions of its own; name one, such as "
                f"{self.name.partition('@')[0]}@0"
            )
        return self.sites[0]

    @property
    def stream(self) -> str:
        """Return the stream of all its sites."""
        return self.sites[0].stream

    @property
    def layer(self) -> tuple[str, int, str]:
        """Stream, layer and quantity: heads of one block are parallel, layers come one after the other."""
        return self.stream, self.sites[0].layer, self.sites[0].quantity

    def limit(self, change: TokenEdit) -> TokenEdit:
        """The change within this place: of one head, if it is one."""
        return change if self.head is None else OfOneHead(change, self.head, self.heads)


def resolve_sites(pattern: str, policy: "Model") -> list[SiteGroup]:
    """The places that a pattern names.

    `backbone.*` every layer, each a place; `backbone.02` one; `expert.03@0-4` a layer over iterations 0 to 4,
    changed at each of them; `expert.03` over all; `kv.02` what block 2 hands over to the acting stream, keys and
    values together. A quantity may follow the layer: `kv.02.values`, `backbone.02.mlp`, `backbone.02.heads` for
    all heads of a block, `backbone.02.heads.3` for one, `backbone.*.heads.*` for each. Raises UnknownSiteError,
    and UnsupportedInterventionError for `kv` of a family that has none.
    """
    match, streams = _PATTERN.fullmatch(pattern), policy.every_stream()
    if match is not None and match["stream"] == KV_STREAM:
        interventions = getattr(policy, "interventions", None)
        if interventions is not None:
            interventions.check("kv", policy.card.family)
    if match is None or match["stream"] not in streams:
        raise UnknownSiteError(
            f"{pattern!r} names no place; expected STREAM.LAYER such as backbone.*, backbone.02, expert.03@0-4 or "
            f"backbone.02.heads.3, of the streams {', '.join(streams)}"
        )
    stream, quantity, head = streams[match["stream"]], match["quantity"] or "", match["head"]
    if head is not None and quantity != HEADS:
        raise UnknownSiteError(
            f"{pattern!r} names a head of the quantity {quantity}; expected {HEADS}, such as backbone.02.heads.3"
        )
    every = range(stream.layers - (stream is policy.prompt_kv or quantity not in ("", RESIDUAL)))
    layers = every if match["layer"] == "*" else [int(match["layer"])]
    heads = [None] if head is None else range(stream.heads) if head == "*" else [int(head)]
    first, last = match["first"], match["last"]
    iterations = None if first is None else (int(first), int(last or first))
    return [
        _site_group(stream, PlaceName(stream.name, layer, quantity, number, iterations))
        for layer in layers
        for number in heads
    ]


def resolve_all(patterns: Sequence[str], policy: "Model") -> dict[str, SiteGroup]:
    """The places of several patterns by name, each once. Raises as `resolve_sites` does."""
    return {site_group.name: site_group for pattern in patterns for site_group in resolve_sites(pattern, policy)}


def _site_group(stream: "Stream", name: PlaceName) -> SiteGroup:
    quantities = (name.quantity,) if name.quantity else KV if stream.name == KV_STREAM else (RESIDUAL,)
    low, high = name.iterations or (0, 0)
    sites = tuple(
        site
        for quantity in quantities
        for site in stream.sites(quantity)
        if site.layer == name.layer and (name.iterations is None or low <= (site.iteration or 0) <= high)
    )
    expected = 1 if stream.iterations is None else high - low + 1 if name.iterations else stream.iterations
    expected *= len(quantities)
    if len(sites) != expected or (stream.iterations is None and name.iterations is not None):
        available = f"{stream.layers} layers" + (
            f" and {stream.iterations} iterations" if stream.iterations else ""
        )
        raise UnknownSiteError(f"{name} is no place; the stream {stream.name} has {available}, counted from 0")
    if name.head is not None and name.head >= stream.heads:
        raise UnknownSiteError(f"{name} is no place; a block of {stream.name} has {stream.heads} heads, from 0 on")
    return SiteGroup(str(name), sites, name.head, stream.heads if name.quantity == HEADS else 0)


def positions_of(role: str) -> tuple[int, int] | None:
    """Return first and last position of a role that is spelled as such, like `7` or `7-11`; None for another."""
    match = _POSITIONS.fullmatch(role)
    return None if match is None else (int(match["first"]), int(match["last"] or match["first"]))


def roles_of(policy: "Policy", stream: str, roles: Sequence[str]) -> list[str]:
    """Return the roles that tokens of a stream play, of some; `all` included, tiles where it has a picture."""
    declared = policy.role_names.get(policy.tokens_of(stream), ())
    tiles = TILE_ROLES if any(plays(name, "image") for name in declared) else ()
    return [role for role in roles if role == ALL or role in tiles or any(plays(name, role) for name in declared)]


FINAL_NORM = "final_norm"


def unread_places(
    patterns: Iterable[str], streams: "Mapping[str, Stream]", interventions: Interventions
) -> tuple[str, ...]:
    """Places of these patterns at the end of an unread stream: an edit there changes no action.

    streams: of the run or the policy, by name. interventions: declared by the family.
    """
    places = []
    for pattern in patterns:
        parts = _PATTERN.fullmatch(pattern)
        if parts is None or parts["stream"] not in interventions.unread or parts["stream"] not in streams:
            continue
        last, quantity = streams[parts["stream"]].layers - 1, parts["quantity"] or ""
        reaches_end = parts["layer"] == "*" or int(parts["layer"] or 0) == last
        if quantity in ("", RESIDUAL) and reaches_end:
            places.append(str(PlaceName(parts["stream"], last, quantity)))
        elif quantity == FINAL_NORM:
            places.append(pattern)
    return tuple(dict.fromkeys(places))


def unread_note(places: Iterable[str]) -> str:
    """The sentence about unread places."""
    return (
        f"unread: {', '.join(places)}. Nothing that acts reads the end of this stream, so that an edit there "
        "changes no action whatever probes read in it: a control, no place to steer at"
    )


# -- tokens --------------------------------------------------------------------------------------------------

TILES: Mapping[str, Side] = dict(zip(TILE_ROLES, ("left", "right"), strict=True))
"""Roles by tile, and the tile."""
ENOUGH = 0.1
"""Share of the largest change of any patch by which a patch of the tile changes; less is the filter's blur."""
HALF, NEARLY = 0.5, 0.9
"""Shares of a token's largest change from which a band is its own, and of the largest share in that band."""
BANDS = 32
"""Bands of rows, and of columns, in which a token is looked for."""
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
    """Return (T,) the tokens that play `role`, or are at positions such as `7-11`; EmptyRoleError if none does."""
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
    """Return (T,) the tokens of a stream that play `role`. Raises EmptyRoleError if none does."""
    return mask_of(roles_of_tokens(model, model_input)[stream], stream, role)


def role_token_mask(
    model: "Model", pair: Pair, stream: str, role: str, memo: MutableMapping[Any, Any]
) -> NDArray[np.bool_]:
    """Return (T,) the tokens of a stream that play `role` in a pair's clean inference, tiles among the roles.

    memo: of this pair. A family's own role of that name, a camera called left, comes before the tile. Raises
    EmptyRoleError if no token plays it, UnsupportedInterventionError for a family that does not say which token
    sees what.
    """
    declared = model.role_names.get(model.tokens_of(stream), ())
    if role not in TILES or role in declared or not pair.tiles:
        if (stream, role) not in memo:
            if "roles" not in memo:
                memo["roles"] = roles_of_tokens(model, pair.clean)
            memo[stream, role] = mask_of(memo["roles"][stream], stream, role)
        return np.asarray(memo[stream, role])
    policy: Policy = model  # type: ignore[assignment]  # only observations have tiles
    assert isinstance(pair.clean, Observation)
    policy.interventions.check("tiles", policy.card.family)
    images = token_mask(policy, pair.clean, stream, f"image.{policy.card.cameras[0]}")
    if role not in memo:
        if "patches" not in memo:
            memo["patches"] = patch_embeddings(policy, pair.clean, policy.card.cameras[0])
        memo[role] = tokens_overlapping(policy, pair.clean, pair.tiles[TILES[role]], memo["patches"])
    mask = np.zeros_like(images)
    mask[np.flatnonzero(images)[memo[role]]] = True
    if not mask.any():
        raise EmptyRoleError(f"no patch of {pair.episode} sees the {TILES[role]} tile")
    return mask


def role_tokens(
    model: "Model", pair: Pair, stream: str, role: str, memo: MutableMapping[Any, Any]
) -> TokenSelection:
    """Return where the tokens of `role_token_mask` are; computed once per pair."""
    name = stream, role, "tokens"
    if name not in memo:
        memo[name] = TokenSelection.of(role_token_mask(model, pair, stream, role, memo), model.card.device)
    tokens: TokenSelection = memo[name]
    return tokens


def tokens_overlapping(
    policy: "Policy",
    observation: Observation,
    pixels: NDArray[np.bool_],
    before: NDArray[np.float32] | None = None,
) -> NDArray[np.bool_]:
    """Return (tokens of the picture,) which of them come of patches that see any of some pixels (H, W).

    Of the first camera's picture, in which the renderer says where tiles are. before: what `patch_embeddings`
    gives of `observation`, if it is known.
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
    """Return (V,) by how much the embeddings of patches change with some pixels (H, W) of a camera's picture."""
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
    """Return (tokens of a camera's picture, 4) where each looks: left, top, right, bottom, as shares of it.

    Found by changing a band of rows, then of columns, at a time, so that crops, padding and turns of the policy's
    own preprocessing are in it. NaN for a token that no pixel moves. Costs 2 × `BANDS` + 2 inferences.
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
    """Return (V, D) a camera's patches as they enter the first block of the vision tower."""
    from probe_kit.hooks import capture

    # A tower that sees one picture at a time has the cameras as its iterations, in their order.
    entries = [site for site in policy.every_stream()["vision"].sites() if site.layer == 0]
    site = entries[policy.card.cameras.index(camera) if len(entries) > 1 else 0]
    with capture(policy, [site]) as activations:
        policy.act([observation], [0])
    embeddings: NDArray[np.float32] = activations[site][0].float().cpu().numpy()
    return embeddings
