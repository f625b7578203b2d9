"""Attention of the acting stream to every token of the backbone; descriptive, no evidence of use.

with attention(policy) as mass:
    policy.act([seen], [seed])
mass.of_role(policy.roles([seen])["backbone"], "image")  # {(block, iteration): (B,)}
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import CaptureError, RolesMismatchError
from probe_kit.hooks.contract.model import Policy
from probe_kit.hooks.contract.roles import Roles

Read = tuple[int, int]
"""A block of the backbone whose keys and values are read, and the iteration in which it is."""


@dataclass
class AttentionMass:
    """Shares of attention, by (block of the backbone whose keys are read, iteration).

    by_head: (B, H, T) float32, a mean over acting positions; what is missing to 1 lies on the acting part's own
    tokens. Not causal: a token can receive attention without being used. Serves an optional display only.
    """

    by_head: dict[Read, NDArray[np.float32]] = field(default_factory=dict)

    @property
    def by_read(self) -> dict[Read, NDArray[np.float32]]:
        """(B, T) float32, a mean over heads as well."""
        return {read: mass.mean(axis=1) for read, mass in self.by_head.items()}

    def heads_on(self, tokens: NDArray[np.bool_]) -> dict[Read, NDArray[np.float64]]:
        """The share on some tokens by head, (B, H); tokens: (T,) or (B, T) bool, such as the patches of a tile.

        Raises RolesMismatchError for another number of tokens.
        """
        shares: dict[Read, NDArray[np.float64]] = {}
        for read, mass in self.by_head.items():
            if tokens.shape[-1] != mass.shape[2]:
                raise RolesMismatchError(
                    f"{tokens.shape[-1]} tokens are asked for; attention lies on {mass.shape[2]}. Take the roles "
                    "of the observations that were acted on"
                )
            mask = tokens if tokens.ndim == 1 else tokens[:, None]
            shares[read] = np.where(mask, mass, 0).sum(axis=2, dtype=np.float64)
        return shares

    def on(self, tokens: NDArray[np.bool_]) -> dict[Read, NDArray[np.float64]]:
        """The same as a mean over heads, (B,). Raises RolesMismatchError for another number of tokens."""
        return {read: share.mean(axis=1) for read, share in self.heads_on(tokens).items()}

    def of_role(self, roles: Sequence[Roles], role: str) -> dict[Read, NDArray[np.float64]]:
        """The share on the tokens of one role, (B,). roles: the backbone's, one per row."""
        return self.on(np.stack([row.mask(role) for row in roles]))


@contextmanager
def capture_attention(policy: Policy) -> Iterator[AttentionMass]:
    """Record the attention of the acting stream while `policy` acts once; its actions stay bit-identical.

    Raises UnsupportedInterventionError for a family without attention recording, CaptureError if none occurred.
    """
    policy.interventions.check("attention", policy.card.family)
    mass = AttentionMass()

    def note(block: int, iteration: int, weights: Tensor) -> None:
        if (block, iteration) in mass.by_head:
            raise CaptureError(
                f"{policy.card.family} recorded block {block} twice at iteration {iteration}; act once per context"
            )
        mass.by_head[block, iteration] = weights.detach().float().mean(dim=2).cpu().numpy()

    with policy.record_attention(note):
        yield mass
    if not mass.by_head:
        raise CaptureError(f"{policy.card.family} paid no attention in this context; act once inside of it")
