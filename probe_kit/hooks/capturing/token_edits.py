"""Token edits: the changes of selected tokens of a site, for the edit engine."""

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

        positions = np.flatnonzero(mask)
        if positions.size == mask.size:
            return cls(mask.size, EVERY)
        if positions.size and positions.size == positions[-1] + 1 - positions[0]:
            return cls(mask.size, slice(int(positions[0]), int(positions[-1]) + 1))
        return cls(mask.size, torch.from_numpy(positions).to(device))


def selected(activation: "Tensor", where: TokenIndex) -> "Tensor":
    """(1, T', D) of (1, T, D), a view where they are neighbours."""
    if where is EVERY:
        return activation
    return activation[:, where] if isinstance(where, slice) else activation.index_select(1, where)


class TokenEdit(Protocol):
    """A change of the tokens of a site."""

    def __call__(self, site: Site, activation: "Tensor", where: TokenIndex) -> "Tensor":
        """Return (1, T', D) of as many float32 tokens, and leave `activation` as it is. where: their positions."""


@dataclass(frozen=True)
class ReplaceWith:
    """Replace tokens with the same tokens of another inference."""

    source: "ActivationCache"
    tokens: int

    def __call__(self, site: Site, activation: "Tensor", where: TokenIndex) -> "Tensor":
        """The source's."""
        del activation
        other = self.source[site]
        if other.shape[1] != self.tokens:
            raise CaptureError(
                f"the source's {site} has {other.shape[1]} tokens; expected {self.tokens}, as in the clean one"
            )
        return selected(other, where).float()


@dataclass(frozen=True)
class ReplaceInSubspace:
    """Replace the component within a subspace by another inference's. basis: (K, D) orthonormal.

    complement: the other way round: all but that component is replaced.
    """

    source: "ActivationCache"
    tokens: int
    basis: NDArray[np.float32]
    complement: bool = False

    def __call__(self, site: Site, activation: "Tensor", where: TokenIndex) -> "Tensor":
        """Return a + (source − a) P of the activation a; with complement, a + (source − a) (1 − P)."""
        import torch

        apart = ReplaceWith(self.source, self.tokens)(site, activation, where) - activation
        directions = torch.tensor(self.basis, device=activation.device)
        within = (apart @ directions.T) @ directions
        edited: Tensor = activation + (apart - within if self.complement else within)
        return edited


@dataclass(frozen=True)
class OfOneHead:
    """Another edit, of the features of one head; those of the other heads stay. heads: side by side in a token."""

    change: TokenEdit
    head: int
    heads: int

    def __call__(self, site: Site, activation: "Tensor", where: TokenIndex) -> "Tensor":
        """Return the activation with the edit's result in the columns of the head."""
        size = activation.shape[-1] // self.heads
        columns = slice(self.head * size, (self.head + 1) * size)
        edited = activation.clone()
        edited[..., columns] = self.change(site, activation, where)[..., columns]
        return edited


@dataclass(frozen=True)
class AddVector:
    """Add a vector (D,), the same for every token, or the t-th of (T, D) to the t-th token; T may be more."""

    vector: NDArray[np.float32]

    def __call__(self, site: Site, activation: "Tensor", where: TokenIndex) -> "Tensor":
        """Return the activation plus the vector. Raises CaptureError for more tokens than vectors."""
        import torch

        del site, where
        vector, tokens = self.vector, activation.shape[1]
        if vector.ndim == 2:
            if len(vector) < tokens:
                raise CaptureError(f"there are {tokens} tokens, and vectors for {len(vector)}")
            vector = vector[:tokens]
        edited: Tensor = activation + torch.tensor(vector, device=activation.device)
        return edited


@dataclass(frozen=True)
class Identity:
    """Leave tokens as they are: written back like any other edit."""

    def __call__(self, site: Site, activation: "Tensor", where: TokenIndex) -> "Tensor":
        """Return the activation."""
        del site, where
        return activation


@dataclass(frozen=True)
class DeclaredEdit:
    """The change that an `Edit` declares. vector: (D,) or (T, D), None for `zero`. tokens: T, of every row."""

    edit: Edit
    vector: NDArray[np.float32] | None
    tokens: int

    def __call__(self, site: Site, activation: "Tensor", where: TokenIndex) -> "Tensor":
        """Raises UsageError for a vector of another shape."""
        import torch

        if self.vector is None:
            return torch.zeros_like(activation)
        strength, is_source = self.edit.strength, self.edit.kind == "replace"
        fitting = (self.tokens, activation.shape[2]) if is_source else (activation.shape[2],)
        if self.vector.shape != fitting:
            raise UsageError(f"the vector of the edit of {site} has shape {self.vector.shape}; expected {fitting}")
        other = torch.tensor(self.vector, device=activation.device)
        if is_source:
            other = self._of_rows(other, activation, where)
            # All the way is the source itself, bit for bit, and none of the way what was there.
            return other if strength == 1 else activation + strength * (other - activation)
        if self.edit.kind == "add":
            return activation + strength * other
        direction = other / other.norm()
        removed: Tensor = activation - strength * (activation @ direction)[..., None] * direction
        return removed

    def _of_rows(self, other: "Tensor", activation: "Tensor", where: TokenIndex) -> "Tensor":
        """(1, T', D): the source's tokens at positions that count through all rows of a batch."""
        import torch

        if isinstance(where, slice):
            first = where.start or 0
            where = torch.arange(first, first + activation.shape[1], device=other.device)
        return other.index_select(0, where % self.tokens)[None]
