"""Gradients of a number of the actions at sites, for all sites in one backward pass.

value, slopes = gradients_at(policy, [observation], [seed], policy.sites(), lambda actions: actions[0, :, 1].sum())
slopes["backbone.02.residual"]  # (B, T, D)

A gradient at a site is of everything behind it. At `kv` that is what the acting part reads: the backbone's own
reading of the same keys and values lies beside it.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from probe_kit.hooks.capturing.activation_cache import ActivationCache
from probe_kit.hooks.capturing.capture_context import _attach
from probe_kit.hooks.contract.model import Model, Policy, Tap
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import KV_STREAM, Site

Metric = Callable[[Tensor], Tensor]
"""From (B, chunk, 7) actions, metres and radians, to a number."""


def gradients_at(
    policy: Policy,
    observations: Sequence[Observation],
    seeds: Sequence[int],
    sites: Iterable[Site],
    metric: Metric,
) -> tuple[float, ActivationCache]:
    """The metric of one inference, and its gradient at every site: (B, T, D) float32, zero where nothing reads it.

    Costs about three inferences, however many sites. Raises UnsupportedInterventionError, and what `capture`
    raises.
    """
    policy.interventions.check("gradients", policy.card.family)
    with flowing_tensors(policy, sites) as flowing:
        value = metric(policy.differentiable(observations, seeds))
    return float(value.detach()), flowing.gradients_of(value)


@dataclass
class FlowingTensors:
    """The tensors themselves that passed at sites, with the taps that select the sites' parts of them."""

    passed: dict[Site, tuple[Tap, Tensor]] = field(default_factory=dict)

    def gradients_of(self, value: Tensor) -> ActivationCache:
        """The gradient of a number at every site. Frees the graph."""
        gradients = ActivationCache()
        tensors = [tensor for _, tensor in self.passed.values()]
        slopes: Sequence[Tensor | None] = [None] * len(tensors)
        if value.requires_grad:
            slopes = torch.autograd.grad(value, tensors, allow_unused=True)
        for (site, (tap, tensor)), slope in zip(self.passed.items(), slopes, strict=True):
            gradients._kept[site] = tap.select(torch.zeros_like(tensor) if slope is None else slope).float()
        return gradients


@contextmanager
def flowing_tensors(model: Model, sites: Iterable[Site]) -> Iterator[FlowingTensors]:
    """Keep what passes at `sites` while the model runs once with a graph.

    An input is kept as the very tensor that flows, so that the norm and the path around the block both count. Of
    an output, and of `kv`, a copy passes on: what read the tensor before does not count, and what is added to it
    in place does not reach it. The first tensor of all becomes a leaf: nothing above it is kept.
    """
    flowing = FlowingTensors()

    def keep(site: Site, tap: Tap, passing: Tensor) -> Tensor | None:
        is_copied = tap.end == "output" or site.stream == KV_STREAM
        tensor = passing.view_as(passing) if is_copied and passing.requires_grad else passing
        if not tensor.requires_grad:
            tensor.requires_grad_()
        flowing.passed[site] = (tap, tensor)
        return tensor.clone() if is_copied else None

    with ExitStack() as stack:
        hooks = _attach(model, sites, keep, stack)
        yield flowing
    for hook in hooks:
        hook.check_count()


@contextmanager
def frozen(network: nn.Module) -> Iterator[None]:
    """Run the body with a graph of activations alone: no weight asks for its gradient."""
    trained = [weight for weight in network.parameters() if weight.requires_grad]
    for weight in trained:
        weight.requires_grad_(False)
    try:
        with torch.enable_grad():
            yield
    finally:
        for weight in trained:
            weight.requires_grad_(True)
