"""How much attention what acts pays to every token of the backbone. It weighs; only an edit says what is read.

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
from probe_kit.hooks.model import Policy
from probe_kit.hooks.roles import Roles


@dataclass
class AttentionMass:
    """Shares of attention, by (block of the backbone whose memory is read, iteration): (B, T) float32.

    A mean over heads and acting positions; what is missing to 1 lies on the acting part's own tokens. Not a cause:
    a token can be weighed and not be used, and an optional display is all that it serves.
    """

    by_read: dict[tuple[int, int], NDArray[np.float32]] = field(default_factory=dict)

    def on(self, tokens: NDArray[np.bool_]) -> dict[tuple[int, int], NDArray[np.float64]]:
        """The share on some tokens, (B,); tokens: (T,) or (B, T) bool, such as the patches of a tile.

        Raises RolesMismatchError for another number of tokens.
        """
        shares: dict[tuple[int, int], NDArray[np.float64]] = {}
        for read, mass in self.by_read.items():
            if tokens.shape[-1] != mass.shape[1]:
                raise RolesMismatchError(
                    f"{tokens.shape[-1]} tokens are asked for; attention lies on {mass.shape[1]}. Take the roles "
                    "of the observations that were acted on"
                )
            shares[read] = np.where(tokens, mass, 0).sum(axis=1, dtype=np.float64)
        return shares

    def of_role(self, roles: Sequence[Roles], role: str) -> dict[tuple[int, int], NDArray[np.float64]]:
        """The share on the tokens of one role, (B,). roles: the backbone's, one per row."""
        return self.on(np.stack([row.mask(role) for row in roles]))


@contextmanager
def attention(policy: Policy) -> Iterator[AttentionMass]:
    """Note the attention of what acts while `policy` acts once; its actions stay the same, bit for bit.

    Raises UnsupportedInterventionError for a family that does not tell it, CaptureError if nothing was weighed.
    """
    policy.interventions.check("attention", policy.card.family)
    found = AttentionMass()

    def note(block: int, iteration: int, weights: Tensor) -> None:
        if (block, iteration) in found.by_read:
            raise CaptureError(
                f"{policy.card.family} weighed block {block} twice at iteration {iteration}; act once per context"
            )
        found.by_read[block, iteration] = weights.detach().float().mean(dim=(1, 2)).cpu().numpy()

    with policy.weighing(note):
        yield found
    if not found.by_read:
        raise CaptureError(f"{policy.card.family} paid no attention in this context; act once inside of it")
