"""One patched inference: the activations of cells come from another inference."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.capturing.edit_engine import apply_patches
from probe_kit.hooks.capturing.token_edits import (
    ReplaceInSubspace,
    ReplaceWith,
    TokenEdit,
    TokenSelection,
)
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.edits.sites import mask_of
from probe_kit.intervene.kinds.joint.cells import Cell
from probe_kit.intervene.patching.inference import Output, infer, roles_of_tokens, run_with_cache
from probe_kit.intervene.patching.pairs import Pair

if TYPE_CHECKING:
    from probe_kit.hooks import ActivationCache, Model

Cells = Cell | Sequence[Cell]
"""One cell, or several that are patched together in one inference."""
Basis = NDArray[np.floating]
"""(K, D), orthonormal rows."""


def patch_cells(
    model: "Model", pair: Pair, cells: Cells, *, along: Basis | None = None, rest: bool = False
) -> Output:
    """The output of the clean inference with the cells' activations from the source.

    along: patch only the component within the span of its rows (K, D), at every cell. rest: patch all but that
    component. Two inferences. Raises EmptyRoleError for a role that no token has now, UsageError for a basis that
    is not orthonormal, CaptureError for a source with another number of tokens.
    """
    own = together(cells)
    _, source = run_with_cache(model, pair.source, pair.seed, [cell.place.name for cell in own])
    return infer_patched(model, pair, own, source, along, rest)


def infer_patched(
    model: "Model",
    pair: Pair,
    cells: Sequence[Cell],
    source: "ActivationCache",
    along: Basis | None = None,
    rest: bool = False,
) -> Output:
    """The same with activations of the source that are captured already; one inference."""
    roles = roles_of_tokens(model, pair.clean)
    changes: dict[Site, list[tuple[TokenSelection, TokenEdit]]] = {}
    for cell in cells:
        mask = mask_of(roles[cell.place.stream], cell.place.stream, cell.role)
        tokens = TokenSelection.of(mask, model.card.device)
        change = cell.place.limit(_change(source, mask.size, along, rest))
        for site in cell.place.sites:
            changes.setdefault(site, []).append((tokens, change))
    with apply_patches(model, changes):
        return infer(model, pair.clean, pair.seed)


def together(cells: Cells) -> tuple[Cell, ...]:
    """One cell or several as a tuple. Raises UsageError for none."""
    found = (cells,) if isinstance(cells, Cell) else tuple(cells)
    if not found:
        raise UsageError("no cell is given; name at least one with find_cells(model, 'backbone.02|image')")
    return found


def _change(source: "ActivationCache", tokens: int, along: Basis | None, rest: bool) -> TokenEdit:
    if along is None:
        if rest:
            raise UsageError("rest patches all but a subspace; give its orthonormal basis as along")
        return ReplaceWith(source, tokens)
    basis = np.atleast_2d(np.asarray(along, np.float32))
    if not np.allclose(basis @ basis.T, np.eye(len(basis)), atol=1e-4):
        raise UsageError(
            f"along has shape {basis.shape} and rows that are not orthonormal; take those of numpy.linalg.qr"
        )
    return ReplaceInSubspace(source, tokens, basis, rest)
