"""What becomes of the selected tokens of a site: token edits, for the edit engine."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, Self, Union

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureError, UsageError
from probe_kit.hooks.capturing.edits import Edit
from probe_kit.hooks.contract.sites import Site

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks.capturing.activation_cache import ActivationCache

TokenIndex = Union["Tensor", slice]
"""Positions of tokens: a slice of neighbours, which copies nothing, or (T',) indices."""
EVERY = slice(None)


@dataclass(frozen=True)
class TokenSelection:
    """Some tokens of a stream. count: how many it has, all rows of a batch together. where: which of them."""

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


def selected(activation: "Tensor", where: TokenIndex) -> "Tensor":
    """(1, T', D) of (1, T, D), a view where they are neighbours."""
    if where is EVERY:
        return activation
    return activation[:, where] if isinstance(where, slice) else activation.index_select(1, where)


class TokenEdit(Protocol):
    """What becomes of the tokens of a site."""

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """(1, T', D) float32 tokens in, as many out, and `own` left as it is. where: their positions."""


@dataclass(frozen=True)
class ReplaceWith:
    """With the same tokens of another inference."""

    source: "ActivationCache"
    tokens: int

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """The source's."""
        del own
        other = self.source[site]
        if other.shape[1] != self.tokens:
            raise CaptureError(
                f"the source's {site} has {other.shape[1]} tokens; expected {self.tokens}, as in the clean one"
            )
        return selected(other, where).float()


@dataclass(frozen=True)
class ReplaceInSubspace:
    """With another inference's component within a subspace; the rest stays. basis: (K, D) orthonormal.

    rest: the other way round, with all but that component, which stays.
    """

    source: "ActivationCache"
    tokens: int
    basis: NDArray[np.float32]
    rest: bool = False

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """own + (source − own) P; with rest own + (source − own) (1 − P)."""
        import torch

        apart = ReplaceWith(self.source, self.tokens)(site, own, where) - own
        directions = torch.tensor(self.basis, device=own.device)
        within = (apart @ directions.T) @ directions
        found: Tensor = own + (apart - within if self.rest else within)
        return found


@dataclass(frozen=True)
class OfOneHead:
    """Another edit, of the features of one head; those of the other heads stay. heads: side by side in a token."""

    change: TokenEdit
    head: int
    heads: int

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """own, with the edit's result in the columns of the head."""
        size = own.shape[-1] // self.heads
        columns = slice(self.head * size, (self.head + 1) * size)
        found = own.clone()
        found[..., columns] = self.change(site, own, where)[..., columns]
        return found


@dataclass(frozen=True)
class AddVector:
    """Add a vector (D,), the same for every token, or the t-th of (T, D) to the t-th token; T may be more."""

    vector: NDArray[np.float32]

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """own + vector. Raises CaptureError for more tokens than vectors."""
        import torch

        del site, where
        vector, tokens = self.vector, own.shape[1]
        if vector.ndim == 2:
            if len(vector) < tokens:
                raise CaptureError(f"there are {tokens} tokens, and vectors for {len(vector)}")
            vector = vector[:tokens]
        found: Tensor = own + torch.tensor(vector, device=own.device)
        return found


@dataclass(frozen=True)
class Identity:
    """As they are: written back like any other edit."""

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """own."""
        del site, where
        return own


@dataclass(frozen=True)
class DeclaredEdit:
    """What an `Edit` says. vector: (D,) or (T, D), None for `zero`. tokens: T, of every row."""

    edit: Edit
    vector: NDArray[np.float32] | None
    tokens: int

    def __call__(self, site: Site, own: "Tensor", where: TokenIndex) -> "Tensor":
        """Raises UsageError for a vector of another shape."""
        import torch

        if self.vector is None:
            return torch.zeros_like(own)
        strength, is_source = self.edit.strength, self.edit.kind == "replace"
        fitting = (self.tokens, own.shape[2]) if is_source else (own.shape[2],)
        if self.vector.shape != fitting:
            raise UsageError(f"the vector of the edit of {site} has shape {self.vector.shape}; expected {fitting}")
        other = torch.tensor(self.vector, device=own.device)
        if is_source:
            other = self._of_rows(other, own, where)
            # All the way is the source itself, bit for bit, and none of the way what was there.
            return other if strength == 1 else own + strength * (other - own)
        if self.edit.kind == "add":
            return own + strength * other
        direction = other / other.norm()
        removed: Tensor = own - strength * (own @ direction)[..., None] * direction
        return removed

    def _of_rows(self, other: "Tensor", own: "Tensor", where: TokenIndex) -> "Tensor":
        """(1, T', D): the source's tokens at positions that count through all rows of a batch."""
        import torch

        if isinstance(where, slice):
            first = where.start or 0
            where = torch.arange(first, first + own.shape[1], device=other.device)
        return other.index_select(0, where % self.tokens)[None]
