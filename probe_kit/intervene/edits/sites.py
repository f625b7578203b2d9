"""Places: sites that are changed together, and the tokens at which they are."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import EmptyRoleError, UnknownSiteError, UsageError
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import KV, KV_STREAM, Site
from probe_kit.hooks.contract.views import plays

if TYPE_CHECKING:
    from probe_kit.hooks import Policy, Stream

TILE_ROLES = ("image.left", "image.right")
"""Roles of the patches that see one of the two pictures; see `tiles`."""
ALL = "all"
"""The role of every token but padding."""
_PATTERN = re.compile(r"(?P<stream>[a-z][a-z_0-9]*)\.(?P<layer>\*|\d+)(@(?P<first>\d+)(-(?P<last>\d+))?)?")


@dataclass(frozen=True)
class SiteGroup:
    """One layer of a stream, over some of its iterations; of `kv` its keys and values together."""

    name: str
    sites: tuple[Site, ...]

    @property
    def only_site(self) -> Site:
        """Its one site, where a direction can be found. Raises UnknownSiteError if it has several."""
        if self.stream == KV_STREAM:
            raise UnknownSiteError(
                f"{self.name} is keys and values, of which a run stores no means, so that no direction is found; "
                "name a place of another stream, such as backbone.02"
            )
        if len(self.sites) != 1:
            raise UnknownSiteError(
                f"{self.name} is {len(self.sites)} sites, each with directions of its own; name one, such as "
                f"{self.name.partition('@')[0]}@0"
            )
        return self.sites[0]

    @property
    def stream(self) -> str:
        """Of all its sites."""
        return self.sites[0].stream


def resolve_sites(pattern: str, policy: "Policy") -> list[SiteGroup]:
    """The places that a pattern names.

    `backbone.*` every layer, each a place; `backbone.02` one; `expert.03@0-4` a layer over iterations 0 to 4,
    changed at each of them; `expert.03` over all; `kv.02` what block 2 hands over to the acting stream, keys and
    values together. Raises UnknownSiteError, and UnsupportedInterventionError for `kv` of a family that has
    none.
    """
    match, streams = _PATTERN.fullmatch(pattern), policy.every_stream()
    if match is not None and match["stream"] == KV_STREAM:
        policy.interventions.check("kv", policy.card.family)
    if match is None or match["stream"] not in streams:
        raise UnknownSiteError(
            f"{pattern!r} names no place; expected STREAM.LAYER such as backbone.*, backbone.02 or expert.03@0-4, "
            f"of the streams {', '.join(streams)}"
        )
    stream = streams[match["stream"]]
    every = range(stream.layers if stream is not policy.prompt_kv else stream.layers - 1)
    layers = every if match["layer"] == "*" else [int(match["layer"])]
    return [_place(stream, layer, match["first"], match["last"]) for layer in layers]


def _place(stream: "Stream", layer: int, first: str | None, last: str | None) -> SiteGroup:
    name = f"{stream.name}.{layer:02d}"
    if first is not None:
        name += f"@{first}" if last is None else f"@{first}-{last}"
    quantities = KV if stream.name == KV_STREAM else ("residual",)
    low, high = int(first or 0), int(last or first or 0)
    sites = tuple(
        site
        for quantity in quantities
        for site in stream.sites(quantity)
        if site.layer == layer and (first is None or low <= (site.iteration or 0) <= high)
    )
    expected = 1 if stream.iterations is None else stream.iterations if first is None else high - low + 1
    expected *= len(quantities)
    if len(sites) != expected or (stream.iterations is None and first is not None):
        there = f"{stream.layers} layers" + (f" and {stream.iterations} iterations" if stream.iterations else "")
        raise UnknownSiteError(f"{name} is no place; the stream {stream.name} has {there}, counted from 0")
    return SiteGroup(name, sites)


def token_mask(policy: "Policy", seen: Observation, stream: str, role: str) -> NDArray[np.bool_]:
    """(T,) the tokens of a stream that play `role`. Raises EmptyRoleError if none does."""
    roles = policy.token_roles([seen])[stream][0]
    mask = roles.valid if role == ALL else roles.mask(role)
    if not mask.any():
        there = ", ".join(dict.fromkeys(span.role for span in roles.spans))
        raise EmptyRoleError(f"no token of {stream} has the role {role!r}; there are {there}")
    return np.asarray(mask, bool)


def roles_of(policy: "Policy", stream: str, wanted: Sequence[str]) -> list[str]:
    """Those of the wanted roles that tokens of a stream play, `all` included, tiles where it has a picture."""
    named = policy.role_names.get(policy.tokens_of(stream), ())
    tiles = TILE_ROLES if any(plays(name, "image") for name in named) else ()
    return [role for role in wanted if role == ALL or role in tiles or any(plays(name, role) for name in named)]


def check_roles_have_tokens(
    policy: "Policy", streams: Sequence[str], wanted: Sequence[str], usual: Sequence[str]
) -> None:
    """Raise UsageError for a wanted role that no token of these streams plays.

    usual: the roles that are tried if nothing is said, of which one that is there will do.
    """
    there = {role for stream in streams for role in roles_of(policy, stream, wanted)}
    missing = [role for role in wanted if role not in there]
    if not missing or (there and tuple(wanted) == tuple(usual)):
        return
    named = [name for stream in streams for name in policy.role_names.get(policy.tokens_of(stream), ())]
    raise UsageError(
        f"no token of {', '.join(streams)} has the role {missing[0]!r}; expected one of "
        f"{', '.join(dict.fromkeys((ALL, *named)))}"
    )
