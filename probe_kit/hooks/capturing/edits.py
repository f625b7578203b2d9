"""Edits as data: what is changed in a stream while a model runs, hashable as part of a run's identity.

move = Edit("add", (Site("backbone", 2),), roles=("language",), vector=vector_hash(direction), strength=2.0)
with apply_edits(model, [move], seen, {move.vector: direction}) as edit_log:
    model.act(seen, seeds)
edit_log.entries  # what fired where, and how far it moved
"""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.sites import Site

Kind = Literal["zero", "add", "remove", "replace"]
Vectors = Mapping[str, NDArray[np.float32]]
"""Directions (D,) and sources (T, D) by their `vector_hash`."""


@dataclass(frozen=True)
class Edit:
    """One change of some sites, applied row by row.

    kind: `zero` sets to zero; `add` adds `strength` times a direction; `remove` takes away `strength` times the
    component along it; `replace` goes the share `strength` of the way to a source, token by token.
    roles: of the tokens that change, such as `language` or `image`; None for all but padding.
    vector: `vector_hash` of the direction (D,) or source (T, D); "" for `zero`.
    Raises UsageError for a combination that means nothing.
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
    """Hex sha256 of shape and float32 bytes: the name of a direction or source."""
    values = np.ascontiguousarray(vector, np.float32)
    return hashlib.sha256(str(values.shape).encode() + values.tobytes()).hexdigest()
