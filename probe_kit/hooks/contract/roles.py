"""Token roles: the kind of each position of a stream, and the pooled views made from them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import EmptyRoleError, RolesMismatchError, UnknownSiteError
from probe_kit.hooks.contract.sites import PADDING, plays


class Span(NamedTuple):
    """Positions `start` up to, not including, `stop` play `role`."""

    role: str
    start: int
    stop: int


@dataclass(frozen=True)
class Roles:
    """The roles of one sequence: spans that cover every position once, in order.

    Roles are `image.<camera>`, `language`, `state`, `action`, `special` and `padding`; `image` names the positions
    of all cameras, so that poolings compare across families.
    """

    spans: tuple[Span, ...]

    def __post_init__(self) -> None:
        start = 0
        for span in self.spans:
            if span.start != start or span.stop <= span.start:
                raise ValueError(f"spans must tile the sequence without gaps or overlaps; got {self.spans}")
            start = span.stop

    @classmethod
    def from_labels(cls, labels: Sequence[str]) -> "Roles":
        """Run-length encode one label per position."""
        spans: list[Span] = []
        for position, role in enumerate(labels):
            if spans and spans[-1].role == role:
                spans[-1] = spans[-1]._replace(stop=position + 1)
            else:
                spans.append(Span(role, position, position + 1))
        return cls(tuple(spans))

    @classmethod
    def padded(cls, rows: Sequence[Sequence[str]], front: bool = False) -> "list[Roles]":
        """The roles of a batch: rows of labels, filled up to the longest with padding behind, or in `front`."""
        longest = max(map(len, rows))
        filled = [(row, [PADDING] * (longest - len(row))) for row in rows]
        return [cls.from_labels([*fill, *row] if front else [*row, *fill]) for row, fill in filled]

    def __len__(self) -> int:
        return self.spans[-1].stop if self.spans else 0

    def mask(self, role: str) -> NDArray[np.bool_]:
        """Return (T,) bool: the positions of one role, or of all `<role>.<…>`."""
        mask = np.zeros(len(self), dtype=bool)
        for span in self.spans:
            if plays(span.role, role):
                mask[span.start : span.stop] = True
        return mask

    @property
    def valid(self) -> NDArray[np.bool_]:
        """The mask (T,) bool of every position but padding."""
        return ~self.mask(PADDING)


def pool(tokens: Tensor, roles: Roles, views: Sequence[str]) -> Tensor:
    """Return pooled views of one sequence, reduced in float32 on the device of `tokens`.

    Padding enters no view.

    Args:
        tokens: (..., T, D), any float dtype.
        roles: The roles of the T positions.
        views: Names as in `view_names`.

    Returns:
        (..., V, D) float32, the V views in the order of `views`.

    Raises:
        EmptyRoleError: For a view without a token.
        RolesMismatchError: For roles of another length.
        UnknownSiteError: For an unknown view.
    """
    if tokens.shape[-2] != len(roles):
        raise RolesMismatchError(
            f"the stream has {tokens.shape[-2]} tokens but the model names roles for {len(roles)}; "
            "the adapter's roles() does not describe this model's packing"
        )
    return _matrix(roles, tuple(views), tokens.device) @ tokens.float()


def pool_weights(roles: Sequence[Roles], views: Sequence[str], device: torch.device | str) -> Tensor:
    """Return what makes pooled views of the tokens of several rows, as (B, V, T) float32 on `device`.

    Their product with tokens (B, T, D) gives the views of `pool`. It belongs before the inference: a copy to a GPU
    would stall the model.

    Args:
        roles: The roles of the T positions, row by row.
        views: Names as in `view_names`.
        device: The device of the tokens.

    Raises:
        EmptyRoleError: For a view without a token.
        RolesMismatchError: For rows of different lengths.
        UnknownSiteError: For an unknown view.
    """
    if len({len(row) for row in roles}) > 1:
        raise RolesMismatchError(
            f"the rows of a batch have {', '.join(str(len(row)) for row in roles)} positions; pad the shorter ones"
        )
    return _matrices(tuple(roles), tuple(views), torch.device(device))


@lru_cache(maxsize=64)
def _matrices(roles: tuple[Roles, ...], views: tuple[str, ...], device: torch.device) -> Tensor:
    """Return (B, V, T) float32 weights."""
    with torch.inference_mode(False):
        return torch.stack([_matrix(row, views, device) for row in roles])


# The weights depend on the packing alone, and a run has few packings.
@lru_cache(maxsize=1024)
def _matrix(roles: Roles, views: tuple[str, ...], device: torch.device) -> Tensor:
    """Return (V, T) float32 weights; pooling runs at every firing of every site, with few different roles."""
    weights = np.stack([_weights(roles, view) for view in views]).astype(np.float32)
    return torch.from_numpy(weights).to(device)


def _weights(roles: Roles, view: str) -> NDArray[np.float64]:
    valid = roles.valid
    if view == "last":  # the last token that is no padding; where padding stands in front, the last position
        weights = np.zeros(len(roles))
        weights[np.flatnonzero(valid)[-1]] = 1
        return weights
    if view == "mean":
        mask = valid
    elif view.startswith("mean:"):
        mask = roles.mask(view.removeprefix("mean:"))
    else:
        raise UnknownSiteError(f"unknown view {view!r}; expected mean, last or mean:<role>")
    if not mask.any():
        raise EmptyRoleError(f"no token for view {view!r}; roles present: {sorted({s.role for s in roles.spans})}")
    return np.asarray(mask / mask.sum(), np.float64)
