"""Places of a network that are changed together: their names, their sites, and the roles of tokens there."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from probe_kit.errors import UnknownSiteError
from probe_kit.hooks.capturing.edits import OfOneHead, TokenEdit
from probe_kit.hooks.contract.declared import Interventions
from probe_kit.hooks.contract.sites import HEADS, KV, KV_STREAM, Site, plays
from probe_kit.suite.items import Side

if TYPE_CHECKING:
    from probe_kit.hooks import Model, Policy, Stream

TILE_ROLES = ("image.left", "image.right")
"""Roles of the patches that see one of the two pictures; see `tokens`."""
TILES: Mapping[str, Side] = dict(zip(TILE_ROLES, ("left", "right"), strict=True))
"""Tile of each of these roles."""
ALL = "all"
"""Role of every token but padding."""
RESIDUAL = "residual"
SHORTEST_RANGE = 3
"""Number of consecutive layers from which on they are named by their first and last."""
_POSITIONS = re.compile(r"(?P<first>\d{1,18})(-(?P<last>\d{1,18}))?")
_PATTERN = re.compile(
    r"(?P<stream>[a-z][a-z_0-9]*)\.(?P<layer>\*|\d{1,18})(\.(?P<quantity>[a-z_]+)(\.(?P<head>\*|\d{1,18}))?)?"
    r"(@(?P<first>\d{1,18})(-(?P<last>\d{1,18}))?)?"
)


@dataclass(frozen=True)
class PlaceName:
    """The parts of a place's name: `backbone.02`, `kv.01.values`, `backbone.02.heads.3`, `expert.03@0-4`.

    Attributes:
        quantity: Name of the quantity; empty where it is not named: the residual stream, for `kv` keys and values.
        head: Number of the head, for the quantity `heads`; None for all.
        iterations: First and last iteration; None for all.
    """

    stream: str
    layer: int
    quantity: str = ""
    head: int | None = None
    iterations: tuple[int, int] | None = None

    @classmethod
    def parse(cls, name: str) -> "PlaceName":
        """Split the name of one place into its parts.

        Raises:
            UnknownSiteError: For another form.
        """
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
        """A key that sorts places of one stream: shallow before deep, a layer before its parts."""
        return self.layer, self.iterations or (0, 0), self.quantity, -1 if self.head is None else self.head


def list_places(names: Sequence[str], most: int | None = None) -> str:
    """Return places in words: `backbone.01 to backbone.07 language, kv.02 image`.

    Three or more of one kind in consecutive layers become one range.

    Args:
        names: Names of the places, each with its role if it has one.
        most: Most places and ranges by name, followed by the number of others; None for all.
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
    """One quantity of a layer of a stream, over some of its iterations; for `kv` keys and values together.

    Attributes:
        head: Number of the head that is meant, of sites with `heads` heads; None for all of them.
        heads: Number of heads of such sites; 0 for others.
    """

    name: str
    sites: tuple[Site, ...]
    head: int | None = None
    heads: int = 0

    @property
    def only_site(self) -> Site:
        """The only site of the group, where a direction can be found.

        Raises:
            UnknownSiteError: If it has several sites, or no mean in the run.
        """
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
        """The stream of all its sites."""
        return self.sites[0].stream

    @property
    def layer(self) -> tuple[str, int, str]:
        """The stream, layer and quantity: heads of one block are parallel, layers come one after the other."""
        return self.stream, self.sites[0].layer, self.sites[0].quantity

    def limit(self, change: TokenEdit) -> TokenEdit:
        """Return the change within this place: of one head, if it is one."""
        return change if self.head is None else OfOneHead(change, self.head, self.heads)


def resolve_sites(pattern: str, policy: "Model") -> list[SiteGroup]:
    """Return the places that a pattern names.

    The pattern `backbone.*` is every layer, each a place, and `backbone.02` is one. The pattern `expert.03@0-4` is
    a layer over iterations 0 to 4, changed at each of them, and `expert.03` is over all. The pattern `kv.02` is
    what block 2 passes to the acting stream, keys and values together.

    A quantity may follow the layer: `kv.02.values`, `backbone.02.mlp`, `backbone.02.heads` for all heads of a
    block, `backbone.02.heads.3` for one, `backbone.*.heads.*` for each.

    Raises:
        UnsupportedInterventionError: For `kv` of a family that has none.
        UnknownSiteError: For a pattern that names no place.
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
    """Return the places of several patterns by name, each once.

    Raises as `resolve_sites`.
    """
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
    """Return the roles, of some, that tokens of a stream have; `all` included, tiles where it has a picture."""
    declared = policy.role_names.get(policy.tokens_of(stream), ())
    tiles = TILE_ROLES if any(plays(name, "image") for name in declared) else ()
    return [role for role in roles if role == ALL or role in tiles or any(plays(name, role) for name in declared)]


FINAL_NORM = "final_norm"


def unread_places(
    names: Iterable[str], streams: "Mapping[str, Stream]", interventions: Interventions
) -> tuple[str, ...]:
    """Return those of some places that lie at the end of an unread stream: an edit there changes no action.

    Args:
        names: Names of the places.
        streams: Streams of the run or the policy, by name.
        interventions: Interventions that the family declares.
    """
    unread = []
    for name in names:
        # Streams first: all of `kv` together is a place too, whose name `kv.*` has no parts.
        if (stream := name.partition(".")[0]) in interventions.unread and stream in streams:
            parsed = PlaceName.parse(name)
            is_last = parsed.quantity in ("", RESIDUAL) and parsed.layer == streams[stream].layers - 1
            # The final norm lies behind the last layer, whatever number its site has.
            if is_last or parsed.quantity == FINAL_NORM:
                unread.append(name)
    return tuple(dict.fromkeys(unread))


def unread_note(places: Iterable[str]) -> str:
    """Return the sentence about unread places."""
    return (
        f"unread: {', '.join(places)}. Nothing that acts reads the end of this stream, so that an edit there "
        "changes no action whatever probes read in it: a control, no place to steer at"
    )
