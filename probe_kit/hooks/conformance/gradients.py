"""Checks of actions with a graph: they are the actions, and their gradients are central differences."""

from collections.abc import Sequence
from functools import partial
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from probe_kit.errors import UnsupportedInterventionError
from probe_kit.hooks.capturing.capture_context import capture, edit
from probe_kit.hooks.capturing.gradients import gradients_at
from probe_kit.hooks.conformance.check import SkipTest, check, refused, require, require_close
from probe_kit.hooks.conformance.subject import PolicySubject
from probe_kit.hooks.contract.model import Policy
from probe_kit.hooks.contract.sites import KV, Site

CLOSE = 0.01
"""Relative difference of a gradient from a central difference."""
_AGREED = 0.001
"""Relative difference of two central differences between which a shorter step has nothing to decide."""
STEPS = (1e-2, 3e-3, 1e-3)
"""Lengths of steps, relative to the activation's own norm, until two agree; of all, the two that agree best."""
_ADVICE = (
    "Let `differentiable` compute what `act` computes: pass by `no_grad` and `inference_mode`, detach nothing, "
    "and keep in-place writes away from tensors that sites tap."
)


@check("Actions with a graph are the actions, and weights need no gradient.", _ADVICE)
def actions_with_a_graph_are_the_actions(subject: PolicySubject) -> None:
    policy = _differentiable(subject)
    trained = [weight.requires_grad for weight in _weights(policy)]
    actions = policy.differentiable(subject.batch, range(len(subject.batch)))
    tolerance = 1e-5 if policy.card.dtype == "float32" else 1e-2
    require_close(actions.detach().cpu().numpy(), subject.run(subject.batch), tolerance, "actions with a graph")
    require(not actions.requires_grad, "a graph behind actions although no site is tapped", "none")
    same = [weight.requires_grad for weight in _weights(policy)] == trained
    require(same, "weights that ask for a gradient", "weights as they were")


@check("Gradients at sites are central differences of the action, whatever other sites are tapped.", _ADVICE)
def gradients_at_sites_are_central_differences(subject: PolicySubject) -> None:
    policy, observations = _differentiable(subject), subject.single
    subject.require_float32()
    sites = _some_sites(policy)
    _, slopes = gradients_at(policy, observations, [0], sites, _lateral)
    with capture(policy, sites) as activations:
        subject.run(observations)
    for site in sites:
        _, alone = gradients_at(policy, observations, [0], [site], _lateral)
        apart = float((alone[site] - slopes[site]).abs().max())
        require(
            apart <= 1e-3 * float(slopes[site].abs().max()),
            f"another gradient at {site} if it is tapped alone",
            "the same",
        )
        _require_slope(subject, site, slopes[site], float(activations[site].float().norm()))


def _require_slope(subject: PolicySubject, site: Site, slope: Tensor, norm: float) -> None:
    """Along its own direction, in which it is steepest, a gradient is its norm."""
    steepness = float(slope.norm())
    require(steepness > 0, f"no gradient at {site}", "one: the acting part reads it")
    direction = slope / steepness
    differences: list[float] = []
    for step in STEPS:
        differences.append(_difference(subject, site, direction, step * norm))
        if len(differences) > 1 and abs(differences[-1] - differences[-2]) <= _AGREED * abs(differences[-1]):
            break
    jumps = [abs(after - before) for before, after in pairwise(differences)]
    best = differences[int(np.argmin(jumps)) + 1]
    require(
        abs(best / steepness - 1) <= CLOSE,
        f"at {site} a gradient of {steepness:.6g}",
        f"{best:.6g}, the difference",
    )


def _difference(subject: PolicySubject, site: Site, direction: Tensor, step: float) -> float:
    """(metric at + step − metric at − step) / (2 · step)."""
    values = []
    for sign in (1.0, -1.0):
        with edit(subject.policy, {site: partial(torch.add, sign * step * direction)}):
            values.append(float(_lateral(torch.from_numpy(subject.run(subject.single)).double())))
    return (values[0] - values[1]) / (2 * step)


def _lateral(actions: Tensor) -> Tensor:
    """Metres in y by the whole chunk of the first row."""
    return actions[0, :, 1].sum()


def _some_sites(policy: Policy) -> list[Site]:
    """One in the backbone, the keys and values of the first block, and one where the action is made."""
    acting = [site for site in policy.sites() if policy.streams[site.stream].part == "action"]
    backbone = next(site for site in policy.sites() if policy.streams[site.stream].part == "backbone")
    kv = [] if policy.prompt_kv is None else [Site(policy.prompt_kv.name, 0, quantity) for quantity in KV]
    return [backbone, *kv, acting[len(acting) // 2]]


def _weights(policy: Policy) -> Sequence[Tensor]:
    network = getattr(policy, "network", None)
    return list(network.parameters()) if isinstance(network, torch.nn.Module) else []


def _differentiable(subject: PolicySubject) -> Policy:
    policy = subject.policy
    if not policy.interventions.gradients:
        with refused("differentiable actions", UnsupportedInterventionError, says=policy.card.family):
            policy.differentiable(subject.single, [0])
        raise SkipTest(f"{policy.card.family} declares no gradients, and refuses them by name")
    if policy.embodiment_mismatch() is not None:
        raise SkipTest(f"{policy.card.family} cannot act: its actions do not fit this arm")
    return policy
