"""Edits: declared changes of sites, changes of tokens, and the code that makes them while a model runs once.

move = Edit("add", (Site("backbone", 2),), roles=("language",), vector=vector_hash(direction), strength=2.0)
with apply_edits(model, [move], seen, {move.vector: direction}) as log:
    model.act(seen, seeds)
log.entries  # which sites fired, and how far tokens were moved

`apply_patch` does the same for one observation. It takes the tokens, and the function that changes them, as
objects.
"""

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self, Union, get_args

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import CaptureError, UsageError
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import Site

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks.capturing.capture_context import ActivationCache
    from probe_kit.hooks.contract.model import Model, Policy
    from probe_kit.hooks.contract.roles import Roles


Kind = Literal["zero", "add", "remove", "replace"]
Vectors = Mapping[str, NDArray[np.float32]]
"""The directions (D,) and sources (T, D) by their `vector_hash`."""


@dataclass(frozen=True)
class Edit:
    """A change of some sites, applied row by row.

    Attributes:
        kind: `zero` sets to zero; `add` adds `strength` times a direction; `remove` takes away `strength` times
            the component along it; `replace` goes the share `strength` of the way to a source, token by token.
        roles: The roles of the tokens that change, such as `language` or `image`; None for all but padding.
        vector: `vector_hash` of the direction (D,) or source (T, D); "" for `zero`.
        strength: A finite number; 1 is the whole change.

    Raises:
        UsageError: For a combination that means nothing.
    """

    kind: Kind
    sites: tuple[Site, ...]
    roles: tuple[str, ...] | None = None
    vector: str = ""
    strength: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise UsageError(f"edit kind {self.kind!r} does not exist; use one of {', '.join(get_args(Kind))}")
        if not self.sites:
            raise UsageError(f"the edit {self.kind!r} names no site")
        if (self.kind == "zero") != (not self.vector):
            raise UsageError(f"the edit {self.kind!r} has vector {self.vector!r}; all kinds but zero need one")
        if not np.isfinite(self.strength):
            raise UsageError(f"the edit {self.kind!r} has strength {self.strength}; expected a finite number")

    def to_json(self) -> dict[str, Any]:
        """Return plain values, as part of a run's identity."""
        return {**asdict(self), "sites": [str(site) for site in self.sites], "roles": list(self.roles or ())}


def vector_hash(vector: NDArray[np.floating]) -> str:
    """Return the hex sha256 of shape and float32 bytes: the name of a direction or source."""
    values = np.ascontiguousarray(vector, np.float32)
    return hashlib.sha256(str(values.shape).encode() + values.tobytes()).hexdigest()


# -- changes of tokens ----------------------------------------------------------------------------------------

TokenIndex = Union["Tensor", slice]
"""The positions of tokens: a slice of neighbours, which copies nothing, or (T',) indices."""
EVERY = slice(None)


@dataclass(frozen=True)
class TokenSelection:
    """Some tokens of a stream.

    Attributes:
        count: The number of tokens of the stream, all rows of a batch together.
        where: The positions of the selected ones among them.
    """

    count: int
    where: TokenIndex

    @classmethod
    def of(cls, mask: NDArray[np.bool_], device: str) -> Self:
        """Return the selection of the tokens that a mask (T,) marks, as positions on the stream's device."""
        import torch

        positions = np.flatnonzero(mask)
        if positions.size == mask.size:
            return cls(mask.size, EVERY)
        if positions.size and positions.size == positions[-1] + 1 - positions[0]:
            return cls(mask.size, slice(int(positions[0]), int(positions[-1]) + 1))
        return cls(mask.size, torch.from_numpy(positions).to(device))


def select_positions(activation: "Tensor", where: TokenIndex) -> "Tensor":
    """Return (1, T', D) of (1, T, D), a view where the positions are neighbours."""
    if where is EVERY:
        return activation
    return activation[:, where] if isinstance(where, slice) else activation.index_select(1, where)


class TokenEdit(Protocol):
    """A change of the tokens of a site."""

    def __call__(self, site: Site, activation: "Tensor", where: TokenIndex) -> "Tensor":
        """Return (1, T', D) of as many float32 tokens, at positions `where`, and leave `activation` as it is."""


@dataclass(frozen=True)
class ReplaceWith:
    """Replace tokens with the same tokens of another inference.

    Attributes:
        source: The activations of that inference.
        tokens: Number of tokens of the inference that is edited, which must be that of the source.
    """

    source: "ActivationCache"
    tokens: int

    def __call__(self, site: Site, activation: "Tensor", where: TokenIndex) -> "Tensor":
        """Return the tokens of the source.

        Raises:
            CaptureError: For a source with another number of tokens.
        """
        del activation
        other = self.source[site]
        if other.shape[1] != self.tokens:
            raise CaptureError(
                f"the source's {site} has {other.shape[1]} tokens; expected {self.tokens}, as in the clean one"
            )
        return select_positions(other, where).float()


@dataclass(frozen=True)
class ReplaceInSubspace:
    """Replace the component within a subspace by another inference's.

    Attributes:
        tokens: The number of tokens of the site.
        basis: (K, D), orthonormal.
        complement: The other way round: all but that component is replaced.
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
    """Change the features of one head by another edit; those of the other heads stay.

    Attributes:
        change: The edit whose result the head gets.
        head: Number of the head, counted from 0.
        heads: Number of heads side by side in a token.
    """

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
        """Return the activation plus the vector.

        Raises:
            CaptureError: For more tokens than vectors.
        """
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
    """The change that an `Edit` declares.

    Attributes:
        edit: The declaration.
        vector: The direction (D,) or source (T, D); None for `zero`.
        tokens: The number T of tokens of every row.
    """

    edit: Edit
    vector: NDArray[np.float32] | None
    tokens: int

    def __call__(self, site: Site, activation: "Tensor", where: TokenIndex) -> "Tensor":
        """Return the tokens after the declared change.

        Raises:
            UsageError: For a vector of another shape.
        """
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
        """Return the source's tokens (1, T', D) at positions that count through all rows of a batch."""
        import torch

        if isinstance(where, slice):
            first = where.start or 0
            where = torch.arange(first, first + activation.shape[1], device=other.device)
        return other.index_select(0, where % self.tokens)[None]


# -- the engine -----------------------------------------------------------------------------------------------

LOG_FIELDS = ("fires", "no_op_fires", "norm", "change", "largest_change")
"""The columns of a stored log."""


@dataclass(frozen=True)
class LogEntry:
    """A firing of an edit.

    Attributes:
        site: Name of the edited site.
        tokens: Number of edited tokens.
        norm: Mean norm of these tokens before the edit.
        moved: Mean distance by which they moved; the column `change` of `LOG_FIELDS`.
        largest: Largest distance; the column `largest_change`.
    """

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
        """Return one log of the entries of several: of inferences, or of streams of one."""
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
        """Return the log (5,) as stored, see `LOG_FIELDS`; `norm` and `change` are means over fires."""
        per = max(self.fires, 1)
        norm, moved = (sum(getattr(entry, name) for entry in self.entries) for name in ("norm", "moved"))
        largest = max((entry.largest for entry in self.entries), default=0.0)
        return np.array([self.fires, self.no_op_fires, norm / per, moved / per, largest])


@contextmanager
def apply_patch(
    policy: "Policy", sites: Sequence[Site], tokens: TokenSelection, change: TokenEdit
) -> Iterator[EditLog]:
    """Change the tokens of some sites while the policy infers once, for one observation.

    Args:
        policy: The policy that infers inside the context.
        sites: The sites that are changed, all in the same way.
        tokens: The tokens that are changed at each site.
        change: The change of these tokens.

    Raises:
        CaptureError: For another number of tokens, and what `hooks.edit` raises, such as for a site that fires
            another number of times than its tap promises.
    """
    with apply_patches(policy, {site: [(tokens, change)] for site in sites}) as log:
        yield log


@contextmanager
def apply_patches(
    model: "Model", changes: Mapping[Site, Sequence[tuple[TokenSelection, TokenEdit]]]
) -> Iterator[EditLog]:
    """Change several sites as `apply_patch` does, each with tokens and changes of its own, in their order."""
    from probe_kit.hooks.capturing.capture_context import edit

    log, active = EditLog(), ActiveEdits()
    with edit(model, {site: partial(active.apply, site, site_changes) for site, site_changes in changes.items()}):
        yield log
    log.entries += active.measured()


@contextmanager
def apply_edits(
    model: "Model", edits: Sequence[Edit], observations: Sequence[Observation], vectors: Vectors | None = None
) -> Iterator[EditLog]:
    """Apply `edits` while the model runs once on `observations`; several at one site act in their order.

    Args:
        model: The model that runs inside the context.
        edits: The declared changes.
        observations: The observations on which the model runs; the roles of their tokens say which tokens change.
        vectors: The arrays that the edits name by their hash; None where no edit names one.

    Raises:
        UsageError: For a vector that is missing, has another hash or does not fit, and for a site without roles.
        UnknownSiteError: For a site that the model does not have, and what `hooks.edit` raises.
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
class ActiveEdits:
    """Edits of one inference.

    They are measured after the inference, all at once. An inference drives everything else out of the processor's
    caches, so that a call here costs ten times what it costs in a loop. Therefore a firing only stores tensors.

    Attributes:
        fired: By firing the site and the tokens (1, T', D) before and after it.
    """

    fired: "list[tuple[Site, Tensor, Tensor]]" = field(default_factory=list)

    def apply(
        self, site: Site, changes: Sequence[tuple[TokenSelection, TokenEdit]], activation: "Tensor"
    ) -> "Tensor":
        """Return the activation (B, T, D) as it is to pass; the tokens of all rows are one sequence.

        Raises:
            CaptureError: For a shape with another number of tokens.
        """
        shape = activation.shape
        for number, (tokens, change) in enumerate(changes):
            if shape[0] * shape[1] != tokens.count:
                raise CaptureError(f"{site} passes as {tuple(shape)}; expected {tokens.count} tokens in all")
            flat = activation if shape[0] == 1 else activation.reshape(1, tokens.count, shape[2])
            # What an earlier edit gave is measured later, so that the next one must not write into it.
            activation = self._change(site, flat.clone() if number else flat, tokens.where, change)
        return activation if activation.shape == shape else activation.reshape(shape)

    def _change(self, site: Site, activation: "Tensor", where: TokenIndex, change: TokenEdit) -> "Tensor":
        before = select_positions(activation, where)
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
        """Return an entry per firing, with one transfer for those of one shape: a GPU waits at each."""
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
