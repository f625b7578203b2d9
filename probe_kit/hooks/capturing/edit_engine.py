"""The edit engine: changes tokens of sites while a model runs once, with a log of what was changed and how far.

move = Edit("add", (Site("backbone", 2),), roles=("language",), vector=vector_hash(direction), strength=2.0)
with apply_edits(model, [move], seen, {move.vector: direction}) as log:
    model.act(seen, seeds)
log.entries  # what fired where, and how far it moved

`apply_patch` is the same for one observation, with the tokens and what becomes of them as objects.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureError, UsageError
from probe_kit.hooks.capturing.edits import Edit, Vectors, vector_hash
from probe_kit.hooks.capturing.token_edits import DeclaredEdit, TokenEdit, TokenIndex, TokenSelection, selected
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import Site

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks.contract.model import Model, Policy
    from probe_kit.hooks.contract.roles import Roles

LOG_FIELDS = ("fires", "no_op_fires", "norm", "change", "largest_change")
"""The columns of a stored log."""


@dataclass(frozen=True)
class LogEntry:
    """One firing of an edit: tokens edited, their mean norm before, and how far they moved (mean, largest)."""

    site: str
    tokens: int
    norm: float
    moved: float
    largest: float


@dataclass
class EditLog:
    """A record of what was changed while the context was open, in order of firing; complete when it is left."""

    entries: list[LogEntry] = field(default_factory=list)

    @classmethod
    def sum(cls, logs: Iterable["EditLog"]) -> "EditLog":
        """The log of several inferences, or of several streams of one."""
        return cls([entry for log in logs for entry in log.entries])

    @property
    def fires(self) -> int:
        """The number of firings of edited sites."""
        return len(self.entries)

    @property
    def no_op_fires(self) -> int:
        """The number of firings that moved nothing."""
        return sum(entry.largest == 0 for entry in self.entries)

    def row(self) -> NDArray[np.float64]:
        """(5,) as stored, see `LOG_FIELDS`; `norm` and `change` are means over fires."""
        per = max(self.fires, 1)
        norm, moved = (sum(getattr(entry, name) for entry in self.entries) for name in ("norm", "moved"))
        largest = max((entry.largest for entry in self.entries), default=0.0)
        return np.array([self.fires, self.no_op_fires, norm / per, moved / per, largest])


@contextmanager
def apply_patch(
    policy: "Policy", sites: Sequence[Site], tokens: TokenSelection, change: TokenEdit
) -> Iterator[EditLog]:
    """Change the tokens of some sites while the policy infers once, for one observation.

    Raises CaptureError for another number of tokens, and what `hooks.edit` raises, such as for a site that fires
    another number of times than its tap promises.
    """
    with apply_patches(policy, {site: [(tokens, change)] for site in sites}) as log:
        yield log


@contextmanager
def apply_patches(
    model: "Model", changes: Mapping[Site, Sequence[tuple[TokenSelection, TokenEdit]]]
) -> Iterator[EditLog]:
    """The same at several sites, each with tokens and changes of its own, in their order."""
    from probe_kit.hooks.capturing.capture_context import edit

    log, active = EditLog(), _ActiveEdits()
    with edit(model, {site: partial(active.apply, site, site_changes) for site, site_changes in changes.items()}):
        yield log
    log.entries += active.measured()


@contextmanager
def apply_edits(
    model: "Model", edits: Sequence[Edit], observations: Sequence[Observation], vectors: Vectors | None = None
) -> Iterator[EditLog]:
    """Apply `edits` while the model runs once on `observations`; several at one site act in their order.

    Raises UsageError for a vector that is missing, has another hash or does not fit, UnknownSiteError for a site
    without roles, and what `hooks.edit` raises.
    """
    roles, arrays = model.token_roles(observations), dict(vectors or {})
    changes: dict[Site, list[tuple[TokenSelection, TokenEdit]]] = defaultdict(list)
    for declared in edits:
        vector = _vector(declared, arrays)
        for site in declared.sites:
            model.stream_of(site)
            if site.stream not in roles:
                raise UsageError(f"{site} has no token roles, so that no token can be chosen in it")
            mask = np.stack([_tokens(row, declared.roles) for row in roles[site.stream]])
            if mask.any():
                tokens = TokenSelection.of(mask.ravel(), model.card.device)
                changes[site].append((tokens, DeclaredEdit(declared, vector, mask.shape[1])))
    with apply_patches(model, changes) as log:
        yield log


def _vector(declared: Edit, arrays: Vectors) -> NDArray[np.float32] | None:
    if declared.kind == "zero":
        return None
    if declared.vector not in arrays or vector_hash(arrays[declared.vector]) != declared.vector:
        raise UsageError(
            f"the edit {declared.kind!r} names vector {declared.vector[:12]}; no array of that hash is given"
        )
    return np.asarray(arrays[declared.vector], np.float32)


def _tokens(row: "Roles", roles: tuple[str, ...] | None) -> NDArray[np.bool_]:
    if roles is None:
        return np.asarray(row.valid)
    return np.asarray(np.any([row.mask(role) for role in roles], axis=0))


@dataclass
class _ActiveEdits:
    """Edits of one inference. fired: by firing the site and the tokens (1, T', D) before and after it.

    They are measured after the inference, all at once. An inference drives everything else out of the processor's
    caches, so that every single call here costs ten times what it costs in a loop: they are few.
    """

    fired: "list[tuple[Site, Tensor, Tensor]]" = field(default_factory=list)

    def apply(
        self, site: Site, changes: Sequence[tuple[TokenSelection, TokenEdit]], activation: "Tensor"
    ) -> "Tensor":
        """(B, T, D) as it is to pass; the tokens of all rows are one sequence. Raises CaptureError for a shape."""
        shape = activation.shape
        for number, (tokens, change) in enumerate(changes):
            if shape[0] * shape[1] != tokens.count:
                raise CaptureError(f"{site} passes as {tuple(shape)}; expected {tokens.count} tokens in all")
            flat = activation if shape[0] == 1 else activation.reshape(1, tokens.count, shape[2])
            # What an earlier edit gave is measured later, so that the next one must not write into it.
            activation = self._changed(site, flat.clone() if number else flat, tokens.where, change)
        return activation if activation.shape == shape else activation.reshape(shape)

    def _changed(self, site: Site, activation: "Tensor", where: TokenIndex, change: TokenEdit) -> "Tensor":
        before = selected(activation, where)
        after = change(site, before.float(), where)
        if after.dtype != activation.dtype:
            after = after.to(activation.dtype)
        self.fired.append((site, before, after))
        if after.shape[1] == activation.shape[1]:
            return after
        if not isinstance(where, slice):
            return activation.index_copy_(1, where, after)
        changed = activation.clone()  # `before` is a view, and is measured later
        changed[:, where] = after
        return changed

    def measured(self) -> list[LogEntry]:
        """An entry per firing. One transfer for those of one shape: a GPU waits at each."""
        import torch

        by_shape: dict[torch.Size, list[int]] = {}
        for at, (_, before, _) in enumerate(self.fired):
            by_shape.setdefault(before.shape, []).append(at)
        entries: dict[int, LogEntry] = {}
        for firings in by_shape.values():
            both = torch.cat([tensor for at in firings for tensor in self.fired[at][1:]]).float()
            both[1::2].sub_(both[::2])
            norms = torch.linalg.vector_norm(both, dim=-1).tolist()
            for at, before, moved in zip(firings, norms[::2], norms[1::2], strict=True):
                count = len(moved)
                entry = str(self.fired[at][0]), count, sum(before) / count, sum(moved) / count, max(moved)
                entries[at] = LogEntry(*entry)
        return [entries[at] for at in range(len(self.fired))]
