"""Changing the streams of one inference, with a ledger of what was changed where, and how far."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Protocol, Self, Union

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureError
from probe_kit.hooks.contract.sites import Site

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from probe_kit.hooks import ActivationCache, Policy


@dataclass
class EditLog:
    """What was done in one inference.

    fires: how often an edited site fired. still: of these, the fires that moved nothing. norm, moved: sums over
    fires of the mean norm of the tokens before, and of how far they were moved. largest: of any token.
    """

    fires: int = 0
    no_op_fires: int = 0
    norm: float = 0.0
    moved: float = 0.0
    largest: float = 0.0

    @classmethod
    def sum(cls, edit_logs: Sequence["EditLog"]) -> "EditLog":
        """Of several inferences, or of several streams of one."""
        return cls(
            sum(one.fires for one in edit_logs),
            sum(one.no_op_fires for one in edit_logs),
            sum(one.norm for one in edit_logs),
            sum(one.moved for one in edit_logs),
            max((one.largest for one in edit_logs), default=0.0),
        )

    def row(self) -> NDArray[np.float64]:
        """(5,) as stored; `norm` and `moved` per fire."""
        per = max(self.fires, 1)
        return np.array([self.fires, self.no_op_fires, self.norm / per, self.moved / per, self.largest])


LOG_FIELDS = ("fires", "still", "norm", "moved", "largest")
"""What the columns of a stored ledger are."""


TokenIndex = Union["Tensor", slice]
"""Positions of tokens: a slice of neighbours, which copies nothing, or (T',) indices."""
EVERY = slice(None)


@dataclass(frozen=True)
class TokenSelection:
    """Some tokens of a stream. count: how many it has. where: which of them."""

    count: int
    where: TokenIndex

    @classmethod
    def of(cls, mask: NDArray[np.bool_], device: str) -> Self:
        """mask: (T,). device: of the stream."""
        import torch

        found = np.flatnonzero(mask)
        if found.size == mask.size:
            return cls(mask.size, EVERY)
        if found.size and found.size == found[-1] + 1 - found[0]:
            return cls(mask.size, slice(int(found[0]), int(found[-1]) + 1))
        return cls(mask.size, torch.from_numpy(found).to(device))


class TokenEdit(Protocol):
    """What becomes of the tokens of a site."""

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """(1, T', D) float32 tokens in, as many out, and `own` left as it is. where: their positions."""


@dataclass(frozen=True)
class ReplaceWith:
    """By the same tokens of another inference."""

    source: "ActivationCache"
    tokens: int

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """The donor's."""
        del own
        other = self.source[site]
        if other.shape[1] != self.tokens:
            raise CaptureError(
                f"the donor's {site} has {other.shape[1]} tokens; expected {self.tokens}, as before exchanging"
            )
        return _at(other, where).float()


@dataclass(frozen=True)
class ReplaceInSubspace:
    """By another inference's component along some directions; the rest stays. basis: (K, D) orthonormal."""

    source: "ActivationCache"
    tokens: int
    basis: NDArray[np.float32]

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """own + (donor − own) P."""
        import torch

        apart = ReplaceWith(self.source, self.tokens)(site, own, where) - own
        directions = torch.from_numpy(self.basis).to(own.device)
        found: Tensor = own + (apart @ directions.T) @ directions
        return found


@dataclass(frozen=True)
class AddVector:
    """By a vector (D,), the same for every token."""

    vector: NDArray[np.float32]

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """own + vector."""
        import torch

        del site, where
        found: Tensor = own + torch.from_numpy(self.vector).to(own.device)
        return found


@dataclass(frozen=True)
class Identity:
    """As they are: a dose of zero, which is written back like any other."""

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """own."""
        del site, where
        return own


@contextmanager
def apply_patch(
    policy: "Policy", sites: Sequence[Site], tokens: TokenSelection, change: TokenEdit
) -> Iterator[EditLog]:
    """Change the tokens of some sites while the policy infers once, for one observation.

    The ledger is complete when the context is left. Raises CaptureError for another number of tokens, and what
    `hooks.edit` raises, such as for a site that fires another number of times than its tap promises.
    """
    from probe_kit.hooks.capturing.capture_context import edit

    edit_log, patch = EditLog(), _Patch(tokens, change)
    with edit(policy, {site: partial(patch.max_action_change, site) for site in sites}):
        yield edit_log
    patch.into(edit_log)


def _at(activation: "Tensor", where: TokenIndex) -> "Tensor":
    """(1, T', D) of (1, T, D), a view where they are neighbours."""
    if where is EVERY:
        return activation
    return activation[:, where] if isinstance(where, slice) else activation.index_select(1, where)


@dataclass
class _Patch:
    """Changes what passes. pairs: by shape, behind each other the tokens (1, T', D) of a fire before and after it.

    They are measured behind the inference, all at once. An inference drives everything else out of the processor's
    caches, so that every single call here costs ten times what it costs in a loop: they are few.
    """

    tokens: TokenSelection
    change: TokenEdit
    pairs: "dict[torch.Size, list[Tensor]]" = field(default_factory=dict)

    def max_action_change(self, site: Site, activation: "Tensor") -> "Tensor":
        """(1, T, D) as it is to pass; raises CaptureError for another shape."""
        count, where = self.tokens.count, self.tokens.where
        if activation.shape[0] != 1 or activation.shape[1] != count:
            raise CaptureError(f"{site} passes as {tuple(activation.shape)}; expected one row of {count} tokens")
        before = _at(activation, where)
        after = self.change(site, before.float(), where)
        if after.dtype != activation.dtype:
            after = after.to(activation.dtype)
        self.pairs.setdefault(before.shape, []).extend((before, after))
        if after.shape[1] == count:
            return after
        if not isinstance(where, slice):
            return activation.index_copy_(1, where, after)
        changed = activation.clone()  # `before` is a view, and is measured later
        changed[:, where] = after
        return changed

    def into(self, edit_log: EditLog) -> None:
        """Add all fires up. One transfer for those of one shape: a GPU waits at each."""
        import torch

        for pairs in self.pairs.values():
            both = torch.cat(pairs).float()
            both[1::2].sub_(both[::2])
            norms = torch.linalg.vector_norm(both, dim=-1).tolist()
            for before, after in zip(norms[::2], norms[1::2], strict=True):
                moved, largest = sum(after) / len(after), max(after)
                edit_log.fires += 1
                edit_log.no_op_fires += int(largest == 0)
                edit_log.norm += sum(before) / len(before)
                edit_log.moved += moved
                edit_log.largest = max(edit_log.largest, largest)
