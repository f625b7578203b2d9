"""Attention patterns of one inference, with the roles of both axes; see `hooks.capture_patterns`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import EmptyRoleError, RolesMismatchError
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.pairs import Given
from probe_kit.intervene.patching.inference import infer, sites_of
from probe_kit.intervene.tokens import roles_of_tokens

if TYPE_CHECKING:
    from probe_kit.hooks import Model, Roles


@dataclass(frozen=True)
class AttentionPattern:
    """The attention of the heads of a block, in one inference.

    weights: (H, S, T) float32, rows sum to 1. queries: roles of the S tokens that attend; keys: of the T attended
    ones. Both are None for a stream whose tokens have no roles, such as a vision tower.
    """

    weights: NDArray[np.float32]
    queries: "Roles | None"
    keys: "Roles | None"

    def mean_share(self, role: str, asking: str = "") -> NDArray[np.float64]:
        """(H,) the share on tokens of `role`, a mean over tokens of the role `asking`, or over all real tokens.

        Raises EmptyRoleError if no token attends, or the stream has no roles.
        """
        if self.queries is None or self.keys is None:
            raise EmptyRoleError("the tokens of this stream have no roles; use weights (H, S, T)")
        rows = self.queries.mask(asking) if asking else self.queries.valid
        if not rows.any():
            raise EmptyRoleError(f"no token with the role {asking!r} attends here")
        weights = self.weights[:, rows][..., self.keys.mask(role)]
        return np.asarray(weights.sum(axis=-1, dtype=np.float64).mean(axis=-1))


def attention_patterns(
    model: "Model", model_input: Given, places: Sequence[str], seed: int = 0
) -> dict[Site, AttentionPattern]:
    """The model's own attention patterns in one inference, by site.

    places: patterns of heads, such as `backbone.*.heads` or `expert.02.heads@9`. Raises what `capture_patterns`
    raises.
    """
    from probe_kit.hooks import attended_roles, capture_patterns

    with capture_patterns(model, sites_of(model, places)) as captured:
        infer(model, model_input, seed)
    roles = {name: [stream_roles] for name, stream_roles in roles_of_tokens(model, model_input).items()}
    patterns = {}
    for site, weights in captured.items():
        queries = keys = None
        if site.stream in roles:
            (queries,) = roles[site.stream]
            (keys,) = attended_roles(model, roles, site, weights.shape[-1])
            if len(queries) != weights.shape[2]:
                raise RolesMismatchError(f"{site} has {weights.shape[2]} tokens; its roles are of {len(queries)}")
        patterns[site] = AttentionPattern(weights[0].numpy(), queries, keys)
    return patterns
