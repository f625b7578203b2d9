"""One inference of a policy or of a model that answers: with activations captured, or changed by functions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Union

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import Site
from probe_kit.intervene.pairs import Given
from probe_kit.intervene.places import RESIDUAL, resolve_sites
from probe_kit.intervene.tokens import ANSWERS_NOTHING, roles_of_tokens

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks import ActivationCache, Model, Reading, Roles


Output = Union[NDArray[np.float32], "Reading"]
"""(chunk, 7) actions of a policy, or what a model that answers read."""


@dataclass(frozen=True)
class HookPoint:
    """The place of a hook's call. roles: of the site's tokens; None for a stream without roles, such as vision."""

    site: Site
    roles: "Roles | None"

    @property
    def iteration(self) -> int | None:
        """Return the site's flow-matching step or action token; None where the stream runs once."""
        return self.site.iteration


HookFunction = Callable[["Tensor", HookPoint], "Tensor"]
"""From an activation (1, T, D) and its place to the activation that passes instead, of the same shape."""


def infer(model: "Model", model_input: Given, seed: int = 0) -> Output:
    """One inference. Raises UsageError for an observation of a model that does not act, and the reverse."""
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
    """The sites of all places that patterns name, each once; see `resolve_sites`."""
    sites = [
        site for pattern in patterns for site_group in resolve_sites(pattern, model) for site in site_group.sites
    ]
    return list(dict.fromkeys(sites))


def run_with_cache(
    model: "Model", model_input: Given, seed: int = 0, places: Sequence[str] | None = None
) -> "tuple[Output, ActivationCache]":
    """The output of one inference, and the activations (1, T, D) of it.

    places: patterns such as `backbone.*`, `kv.*`, `expert.03@0-4` or `backbone.*.heads`; None for the residual
    streams that an extraction stores. Raises UnknownSiteError, and what `capture` raises.
    """
    from probe_kit.hooks import capture

    with capture(model, model.sites(RESIDUAL) if places is None else sites_of(model, places)) as cache:
        output = infer(model, model_input, seed)
    return output, cache


def run_with_hooks(model: "Model", model_input: Given, hooks: Mapping[str, HookFunction], seed: int = 0) -> Output:
    """The output of one inference in which functions change activations.

    hooks: by pattern of places a function of (activation, `HookPoint`), called at each of their sites; the
    activation may be changed in place, but must be returned. Raises UsageError for a site that two patterns name,
    and what `edit` raises.
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
