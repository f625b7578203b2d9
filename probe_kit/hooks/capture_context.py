"""The capture context: copies of chosen sites, taken at the moment they fire."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from weakref import WeakSet

import torch
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from probe_kit.errors import (
    CaptureError,
    NonFiniteActivationError,
    SiteFiredTooOftenError,
    SiteNeverFiredError,
)
from probe_kit.hooks.policy import Policy, Tap
from probe_kit.hooks.sites import Site

_listening: WeakSet[Policy] = WeakSet()


class Tape:
    """The captured activations of one inference: `tape[site]` is (B, T, D) on the model's device."""

    def __init__(self) -> None:
        self._copies: dict[Site, Tensor] = {}
        self.fires: dict[str, int] = {}

    def __getitem__(self, site: Site) -> Tensor:
        return self._copies[site]

    def __len__(self) -> int:
        return len(self._copies)

    def _keep(self, site: Site, activation: Tensor) -> None:
        self._copies[site] = activation.detach().clone()


@contextmanager
def capture(policy: Policy, sites: Iterable[Site]) -> Iterator[Tape]:
    """Listen to `sites` while the policy acts once; the model is left exactly as found.

    Raises SiteNeverFiredError or SiteFiredTooOftenError if a site fired another number of times than its
    tap promises, NonFiniteActivationError if a copy holds NaN or infinity, CaptureError if this policy
    is being captured already or a tapped module is compiled.
    """
    if policy in _listening:
        raise CaptureError("this policy is being captured already; leave the first capture before the next")
    tape = Tape()
    listeners = [
        _Listener(policy.tap(group[0]), group, tape) for group in _by_module(dict.fromkeys(sites)).values()
    ]
    with ExitStack() as stack:
        _listening.add(policy)
        stack.callback(_listening.discard, policy)
        for listener in listeners:
            stack.callback(listener.attach().remove)
        yield tape
    for listener in listeners:
        listener.check()


def _by_module(sites: Iterable[Site]) -> dict[Site, list[Site]]:
    """Sites that differ only in the iteration share a hook."""
    groups: dict[Site, list[Site]] = defaultdict(list)
    for site in sites:
        groups[Site(site.stream, site.layer, site.quantity)].append(site)
    return groups


class _Listener:
    """Counts the calls of one module and keeps the asked ones."""

    def __init__(self, tap: Tap, sites: list[Site], tape: Tape) -> None:
        self.tap, self.sites, self.tape = tap, sites, tape
        self.at_fire = {site.iteration or 0: site for site in sites}
        self.count = 0

    def attach(self) -> RemovableHandle:
        if isinstance(self.tap.module, torch._dynamo.OptimizedModule):
            raise CaptureError(
                f"{self.sites[0]} lies in a module compiled by torch.compile, which drops hooks; "
                "load the policy uncompiled to capture it"
            )
        return self.tap.module.register_forward_pre_hook(self._hear)

    def _hear(self, _module: nn.Module, inputs: tuple[Any, ...]) -> None:
        site = self.at_fire.get(self.count)
        if site is not None:
            self.tape._keep(site, inputs[0])
        self.count += 1

    def check(self) -> None:
        site = self.sites[0]
        self.tape.fires[f"{site.stream}.{site.layer:02d}.{site.quantity}"] = self.count
        if self.count != self.tap.fires:
            wrong = SiteNeverFiredError if self.count < self.tap.fires else SiteFiredTooOftenError
            raise wrong(
                f"{site} fired {self.count} times in one inference; expected {self.tap.fires}. The model does "
                "not call this module the way the adapter declares: correct the tap, or capture one act() "
                "per context"
            )
        for kept in self.sites:
            if not torch.isfinite(self.tape[kept]).all():
                raise NonFiniteActivationError(
                    f"{kept} holds NaN or infinity; look for overflow (try --dtype float32) or damaged weights"
                )
