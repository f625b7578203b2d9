"""One inference of a model: with activations captured, changed by functions, or patched from another inference."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Union

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import EmptyRoleError, RolesMismatchError, UsageError
from probe_kit.hooks.capturing.edits import (
    EditLog,
    ReplaceInSubspace,
    ReplaceWith,
    TokenEdit,
    TokenSelection,
    apply_patches,
)
from probe_kit.hooks.contract.declared import ALL_EDITS
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import Site, plays
from probe_kit.intervene.edited_cells import SEPARATOR
from probe_kit.intervene.pairs import Given, Pair
from probe_kit.intervene.places import ALL, RESIDUAL, TILE_ROLES, SiteGroup, positions_of, resolve_sites
from probe_kit.intervene.tokens import ANSWERS_NOTHING, PairTokens, roles_of_tokens

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks import ActivationCache, Model, Reading, Roles


Output = Union[NDArray[np.float32], "Reading"]
"""Actions (chunk, 7) of a policy, or the reading of a model that answers."""


@dataclass(frozen=True)
class HookPoint:
    """The place of a hook's call.

    Attributes:
        site: Site of the activation.
        roles: Roles of the site's tokens; None for a stream without roles, such as vision.
    """

    site: Site
    roles: "Roles | None"

    @property
    def iteration(self) -> int | None:
        """The site's flow-matching step or action token; None where the stream runs once."""
        return self.site.iteration


HookFunction = Callable[["Tensor", HookPoint], "Tensor"]
"""Function from an activation (1, T, D) and its place to the activation that passes instead, of the same shape."""


def infer(model: "Model", model_input: Given, seed: int = 0) -> Output:
    """Make one inference.

    Raises:
        UsageError: For an observation of a model that does not act, or a question to one that does not answer.
    """
    from probe_kit.hooks import AnswerModel, Policy

    if isinstance(model_input, Observation):
        if isinstance(model, Policy):
            # A policy whose actions do not fit the arm still has activations, and a chunk that patches change.
            act = model.act if model.embodiment_mismatch() is None else model.infer_without_acting
            return np.asarray(act([model_input], [seed])[0], np.float32)
        raise UsageError(f"{model.card.family} does not act: give it a question, hooks.Prompt(observation, text)")
    if isinstance(model, AnswerModel):
        return model.read([model_input])
    raise UsageError(ANSWERS_NOTHING.format(model.card.family))


def sites_of(model: "Model", patterns: Sequence[str]) -> list[Site]:
    """Return the sites of all places that patterns name, each once; see `resolve_sites`."""
    sites = [
        site for pattern in patterns for site_group in resolve_sites(pattern, model) for site in site_group.sites
    ]
    return list(dict.fromkeys(sites))


def run_with_cache(
    model: "Model", model_input: Given, seed: int = 0, places: Sequence[str] | None = None
) -> "tuple[Output, ActivationCache]":
    """Return the output of one inference, and its activations (1, T, D).

    Raises as `capture` too.

    Args:
        model: Policy, or model that answers.
        model_input: Observation for a policy, question for a model that answers.
        seed: Seed of the inference.
        places: Patterns such as `backbone.*`, `kv.*`, `expert.03@0-4` or `backbone.*.heads`; None for the residual
            streams that an extraction stores.

    Raises:
        UnknownSiteError: For a pattern that names no place.
    """
    from probe_kit.hooks import capture

    with capture(model, model.sites(RESIDUAL) if places is None else sites_of(model, places)) as cache:
        output = infer(model, model_input, seed)
    return output, cache


def run_with_hooks(model: "Model", model_input: Given, hooks: Mapping[str, HookFunction], seed: int = 0) -> Output:
    """Return the output of one inference in which functions change activations.

    Raises as `edit` too.

    Args:
        model: Policy, or model that answers.
        model_input: Observation for a policy, question for a model that answers.
        hooks: By pattern of places, a function of (activation, `HookPoint`), called at each of their sites. It may
            change the activation in place, but must return it.
        seed: Seed of the inference.

    Raises:
        UsageError: For a site that two patterns name.
    """
    from probe_kit.hooks import edit

    roles = roles_of_tokens(model, model_input)
    edits: dict[Site, Callable[[Tensor], Tensor]] = {}
    for pattern, function in hooks.items():
        for site in sites_of(model, [pattern]):
            if site in edits:
                raise UsageError(f"two patterns name {site}; give every site one function")
            edits[site] = partial(_call, function, HookPoint(site, roles.get(site.stream)))
    with edit(model, edits):
        return infer(model, model_input, seed)


def _call(function: HookFunction, point: HookPoint, activation: "Tensor") -> "Tensor":
    return function(activation, point)


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
"""Orthonormal rows (K, D)."""


def all_but(cells: tuple[Cell, ...], left_out: tuple[Cell, ...]) -> tuple[Cell, ...]:
    """Return the cells without some of them, in their order."""
    return tuple(cell for cell in cells if cell not in left_out)


def sites_of_cells(cells: Sequence[Cell]) -> tuple[Site, ...]:
    """Return the sites of all cells, each once."""
    return tuple(dict.fromkeys(site for cell in cells for site in cell.site_group.sites))


def find_cells(model: "Model", *patterns: str) -> tuple[Cell, ...]:
    """Return the cells that patterns of the form `PLACES|ROLES` name, in their order, each once.

    PLACES have the form of `--sites`: `backbone.*`, `kv.02`, `expert.03@0-4`, `backbone.*.heads.*`. ROLES are
    separated by commas: `all`, roles of the stream's tokens such as `image`, or positions such as `7` or `7-11`.
    Without roles, all tokens are meant.

    Raises:
        UnknownSiteError: For a place that does not exist.
        UsageError: For a role that no token can have, or without a pattern.
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

    It takes two inferences.

    Args:
        model: Policy, or model that answers.
        pair: Pair of inputs.
        cells: Cell, or several that are patched together.
        along: (K, D) orthonormal rows; only the component within their span is patched, at every cell. None to
            patch in full.
        complement: Whether to patch all but that component.

    Raises:
        EmptyRoleError: For a role that no token has now.
        UsageError: For a basis that is not orthonormal.
        CaptureError: For a source with another number of tokens.
    """
    together = as_tuple(cells)
    _, source = run_with_cache(model, pair.source, pair.seed, [cell.site_group.name for cell in together])
    with patch_while_inferring(PairTokens(model, pair), together, source, along, complement):
        return infer(model, pair.clean, pair.seed)


@contextmanager
def patch_while_inferring(
    tokens: PairTokens,
    cells: Sequence[Cell],
    source: "ActivationCache",
    along: Basis | None = None,
    complement: bool = False,
) -> Iterator[EditLog]:
    """Patch cells while the model of `tokens` infers once; every patch of the package is made here.

    Args:
        tokens: Tokens of the pair's clean inference.
        cells: Cells that are patched together.
        source: Activations of the pair's source, at the sites of the cells.
        along: (K, D) orthonormal rows, see `patch_cells`; None to patch in full.
        complement: Whether to patch all but the component within `along`.

    Yields:
        The log of the edits.
    """
    changes: dict[Site, list[tuple[TokenSelection, TokenEdit]]] = {}
    for cell in cells:
        # Several cells may lie at one site: their edits are collected, so that the site is hooked once.
        selection = tokens.selection(cell.site_group.stream, cell.role)
        change = cell.site_group.limit(_change(source, selection.count, along, complement))
        for site in cell.site_group.sites:
            changes.setdefault(site, []).append((selection, change))
    with apply_patches(tokens.model, changes) as log:
        yield log


def as_tuple(cells: Cells) -> tuple[Cell, ...]:
    """Return one cell or several as a tuple.

    Raises:
        UsageError: For none.
    """
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


# -- attention -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AttentionPattern:
    """The attention of the heads of a block, in one inference.

    Attributes:
        weights: (H, S, T) float32, rows sum to 1.
        queries: Roles of the S tokens that attend; None for a stream whose tokens have no roles, such as a vision
            tower.
        keys: Roles of the T attended tokens; None likewise.
    """

    weights: NDArray[np.float32]
    queries: "Roles | None"
    keys: "Roles | None"

    def mean_share(self, role: str, asking: str = "") -> NDArray[np.float64]:
        """Return (H,) the share on tokens of `role`, a mean over tokens of the role `asking`, or over real ones.

        Raises:
            EmptyRoleError: If no token attends, or the stream has no roles.
        """
        if self.queries is None or self.keys is None:
            raise EmptyRoleError("the tokens of this stream have no roles; use weights (H, S, T)")
        rows = self.queries.mask(asking) if asking else self.queries.valid
        if not rows.any():
            raise EmptyRoleError(f"no token with the role {asking!r} attends here")
        weights = self.weights[:, rows][..., self.keys.mask(role)]
        return np.asarray(weights.sum(axis=-1, dtype=np.float64).mean(axis=-1))


def attention_patterns(
    model: "Model", model_input: Given, places: Sequence[str], seed: int = 0
) -> dict[Site, AttentionPattern]:
    """Return the model's own attention patterns in one inference, by site.

    Raises as `capture_patterns`.

    Args:
        model: Policy, or model that answers.
        model_input: Observation for a policy, question for a model that answers.
        places: Patterns of heads, such as `backbone.*.heads` or `expert.02.heads@9`.
        seed: Seed of the inference.
    """
    from probe_kit.hooks import attended_roles, capture_patterns

    with capture_patterns(model, sites_of(model, places)) as captured:
        infer(model, model_input, seed)
    roles = {name: [stream_roles] for name, stream_roles in roles_of_tokens(model, model_input).items()}
    patterns = {}
    for site, weights in captured.items():
        queries = keys = None
        if site.stream in roles:
            (queries,) = roles[site.stream]
            (keys,) = attended_roles(model, roles, site, weights.shape[-1])
            if len(queries) != weights.shape[2]:
                raise RolesMismatchError(f"{site} has {weights.shape[2]} tokens; its roles are of {len(queries)}")
        patterns[site] = AttentionPattern(weights[0].numpy(), queries, keys)
    return patterns
