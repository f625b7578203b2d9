"""Application of edits while a model runs, with a log of their effects.

move = Edit("add", (Site("backbone", 2),), roles=("language",), vector=vector_hash(direction), strength=2.0)
with applied(model, [move], seen, {move.vector: direction}) as ledger:
    model.act(seen, seeds)
ledger.entries  # what fired where, and how far it moved
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import UsageError
from probe_kit.hooks.capturing.capture_context import edit
from probe_kit.hooks.capturing.edits import Edit, Vectors, vector_hash
from probe_kit.hooks.contract.model import Model
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import Site


@dataclass(frozen=True)
class Entry:
    """What one firing of an edit did: tokens changed, their mean norm before, their mean movement."""

    site: str
    tokens: int
    norm: float
    moved: float


@dataclass
class EditLog:
    """What was changed while the context was open, in the order in which it fired."""

    entries: list[Entry] = field(default_factory=list)


@contextmanager
def apply_edits(
    model: Model, edits: Sequence[Edit], seen: Sequence[Observation], vectors: Vectors | None = None
) -> Iterator[EditLog]:
    """Apply `edits` while the model runs once on `seen`; several at one site act in their order.

    Raises UsageError for a vector that is missing, has another hash or does not fit, UnknownSiteError for a site
    without roles, and what `capture_context.edit` raises.
    """
    edit_log, roles, given = EditLog(), model.token_roles(seen), dict(vectors or {})
    changes: dict[Site, list[Callable[[Tensor], Tensor]]] = defaultdict(list)
    for own in edits:
        vector = _vector(own, given)
        for site in own.sites:
            model.stream_of(site)
            if site.stream not in roles:
                raise UsageError(f"{site} has no token roles, so that no token can be chosen in it")
            mask = np.stack([_tokens(row, own.roles) for row in roles[site.stream]])
            changes[site].append(_change(own, site, mask, vector, edit_log))

    def chain(site: Site) -> Callable[[Tensor], Tensor]:
        def rewrite(activation: Tensor) -> Tensor:
            for change in changes[site]:
                activation = change(activation)
            return activation

        return rewrite

    with edit(model, {site: chain(site) for site in changes}):
        yield edit_log


def _vector(own: Edit, given: Vectors) -> NDArray[np.float32] | None:
    if own.kind == "zero":
        return None
    if own.vector not in given or vector_hash(given[own.vector]) != own.vector:
        raise UsageError(f"the edit {own.kind!r} names vector {own.vector[:12]}; no array of that hash is given")
    return np.asarray(given[own.vector], np.float32)


def _tokens(row: Roles, roles: tuple[str, ...] | None) -> NDArray[np.bool_]:
    if roles is None:
        return np.asarray(row.valid)
    return np.asarray(np.any([row.mask(role) for role in roles], axis=0))


def _change(
    own: Edit, site: Site, mask: NDArray[np.bool_], vector: NDArray[np.float32] | None, edit_log: EditLog
) -> Callable[[Tensor], Tensor]:
    """A function from (B, T, D) to the edited copy, which notes in the ledger what it did."""

    def change(activation: Tensor) -> Tensor:
        where = torch.tensor(mask, device=activation.device)
        before = activation.float()
        after = torch.where(where[..., None], _target(own, site, before, vector), before)
        moved, norm = (after - before).norm(dim=-1)[where], before.norm(dim=-1)[where]
        if moved.numel():
            edit_log.entries.append(Entry(str(site), moved.numel(), float(norm.mean()), float(moved.mean())))
        return torch.where(where[..., None], after.to(activation.dtype), activation)

    return change


def _target(own: Edit, site: Site, before: Tensor, vector: NDArray[np.float32] | None) -> Tensor:
    """What every token would become, (B, T, D) float32."""
    if vector is None:
        return torch.zeros_like(before)
    fitting = before.shape[1:] if own.kind == "replace" else before.shape[2:]
    if vector.shape != tuple(fitting):
        raise UsageError(f"the vector of the edit of {site} has shape {vector.shape}; expected {tuple(fitting)}")
    other = torch.tensor(vector, device=before.device)
    if own.kind == "add":
        return before + own.strength * other
    if own.kind == "replace":
        # All the way is the donor itself, bit for bit, and none of the way what was there.
        return other.expand_as(before) if own.strength == 1 else before + own.strength * (other - before)
    direction = other / other.norm()
    removed: Tensor = before - own.strength * (before @ direction)[..., None] * direction
    return removed
