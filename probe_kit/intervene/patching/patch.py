"""Cells, and one patched inference: the activations of cells come from another inference."""

from collections.abc import Iterator, MutableMapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.capturing.edits import (
    EditLog,
    ReplaceInSubspace,
    ReplaceWith,
    TokenEdit,
    TokenSelection,
    apply_patches,
)
from probe_kit.hooks.contract.declared import ALL_EDITS
from probe_kit.hooks.contract.sites import Site, plays
from probe_kit.intervene.pairs import Pair
from probe_kit.intervene.patching.inference import Output, infer, run_with_cache
from probe_kit.intervene.places import ALL, SEPARATOR, TILE_ROLES, SiteGroup, positions_of, resolve_sites
from probe_kit.intervene.tokens import role_tokens

if TYPE_CHECKING:
    from probe_kit.hooks import ActivationCache, Model


@dataclass(frozen=True)
class Cell:
    """The tokens of one role at one place."""

    site_group: SiteGroup
    role: str

    def __str__(self) -> str:
        return f"{self.site_group.name} {self.role}"


Cells = Cell | Sequence[Cell]
"""One cell, or several that are patched together in one inference."""
Basis = NDArray[np.floating]
"""(K, D), orthonormal rows."""


def all_but(cells: tuple[Cell, ...], left_out: tuple[Cell, ...]) -> tuple[Cell, ...]:
    """Return the cells without some of them, in their order."""
    return tuple(cell for cell in cells if cell not in left_out)


def sites_of_cells(cells: Sequence[Cell]) -> tuple[Site, ...]:
    """Return the sites of all cells, each once."""
    return tuple(dict.fromkeys(site for cell in cells for site in cell.site_group.sites))


def find_cells(model: "Model", *patterns: str) -> tuple[Cell, ...]:
    """Return the cells that patterns of the form `PLACES|ROLES` name, in their order, each once.

    PLACES as for `--sites`: `backbone.*`, `kv.02`, `expert.03@0-4`, `backbone.*.heads.*`. ROLES, separated by
    commas: `all`, roles of the stream's tokens such as `image`, or positions such as `7` or `7-11`; without, all
    tokens. Raises UnknownSiteError for a place that is not there, UsageError for a role that no token can have.
    """
    cells = []
    for pattern in patterns:
        places, _, roles = pattern.partition(SEPARATOR)
        for site_group in resolve_sites(places, model):
            for role in roles.split(",") if roles else (ALL,):
                _check_role(model, site_group.stream, role.strip())
                cells.append(Cell(site_group, role.strip()))
    if not cells:
        raise UsageError("no pattern was given; name cells such as 'backbone.*|image'")
    return tuple(dict.fromkeys(cells))


def _check_role(model: "Model", stream: str, role: str) -> None:
    names = model.role_names.get(model.tokens_of(stream), ())
    has_tiles = getattr(model, "interventions", ALL_EDITS).supports("tiles")
    if role == ALL or positions_of(role) or any(plays(name, role) for name in names):
        return
    if role in TILE_ROLES and has_tiles and any(plays(name, "image") for name in names):
        return
    raise UsageError(
        f"no token of {stream} has the role {role!r}; expected one of {', '.join((ALL, *names))}, or "
        "positions such as 7-11"
    )


def patch_cells(
    model: "Model", pair: Pair, cells: Cells, *, along: Basis | None = None, complement: bool = False
) -> Output:
    """Return the output of the clean inference with the cells' activations from the source.

    along: patch only the component within the span of its rows (K, D), at every cell. complement: patch all but
    that component. Two inferences. Raises EmptyRoleError for a role that no token has now, UsageError for a basis
    that is not orthonormal, CaptureError for a source with another number of tokens.
    """
    together = as_tuple(cells)
    _, source = run_with_cache(model, pair.source, pair.seed, [cell.site_group.name for cell in together])
    return infer_patched(model, pair, together, source, along, complement)


def infer_patched(
    model: "Model",
    pair: Pair,
    cells: Sequence[Cell],
    source: "ActivationCache",
    along: Basis | None = None,
    complement: bool = False,
) -> Output:
    """Return the same with activations of the source that are captured already; one inference."""
    with patched(model, pair, cells, source, along, complement):
        return infer(model, pair.clean, pair.seed)


@contextmanager
def patched(
    model: "Model",
    pair: Pair,
    cells: Sequence[Cell],
    source: "ActivationCache",
    along: Basis | None = None,
    complement: bool = False,
    memo: MutableMapping[Any, Any] | None = None,
) -> Iterator[EditLog]:
    """Patch cells of a pair while the model infers once; every patch of the package is made here.

    memo: what is known of the pair's tokens, shared by its patches. Gives the log of the edits.
    """
    memo = {} if memo is None else memo
    changes: dict[Site, list[tuple[TokenSelection, TokenEdit]]] = {}
    for cell in cells:
        # Several cells may lie at one site: their edits are collected, so that the site is hooked once.
        tokens = role_tokens(model, pair, cell.site_group.stream, cell.role, memo)
        change = cell.site_group.limit(_change(source, tokens.count, along, complement))
        for site in cell.site_group.sites:
            changes.setdefault(site, []).append((tokens, change))
    with apply_patches(model, changes) as log:
        yield log


def as_tuple(cells: Cells) -> tuple[Cell, ...]:
    """Return one cell or several as a tuple. Raises UsageError for none."""
    together = (cells,) if isinstance(cells, Cell) else tuple(cells)
    if not together:
        raise UsageError("no cell is given; name at least one with find_cells(model, 'backbone.02|image')")
    return together


def _change(source: "ActivationCache", tokens: int, along: Basis | None, complement: bool) -> TokenEdit:
    if along is None:
        if complement:
            raise UsageError("complement patches all but a subspace; give its orthonormal basis as along")
        return ReplaceWith(source, tokens)
    basis = np.atleast_2d(np.asarray(along, np.float32))
    # Looser than float32, because bases come from files; rows that are not orthogonal would count a part twice.
    if not np.allclose(basis @ basis.T, np.eye(len(basis)), atol=1e-4):
        raise UsageError(
            f"along has shape {basis.shape} and rows that are not orthonormal; take those of numpy.linalg.qr"
        )
    return ReplaceInSubspace(source, tokens, basis, complement)
