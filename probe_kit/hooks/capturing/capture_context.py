"""Contexts that capture or replace the activations of chosen sites while a model runs.

Both leave the model exactly as found, also when the body raises.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any
from weakref import WeakSet

import torch
from torch import Tensor
from torch.utils.hooks import RemovableHandle

from probe_kit.errors import (
    CaptureError,
    NonFiniteActivationError,
    SiteFiredTooOftenError,
    SiteNeverFiredError,
)
from probe_kit.hooks.capturing.activation_cache import ActivationCache
from probe_kit.hooks.contract.model import Model, Tap
from probe_kit.hooks.contract.sites import Site

__all__ = ["ActivationCache", "EditFunction", "Reduce", "capture", "edit"]

Reduce = Callable[[Site, Tensor], Tensor]
EditFunction = Callable[[Tensor], Tensor]
Handle = Callable[[Site, Tap, Tensor], Tensor | None]
"""Receives what passes at a site; of an output, what it returns passes on in its place."""
_captured_now: WeakSet[Model] = WeakSet()


@contextmanager
def capture(model: Model, sites: Iterable[Site], reduce: Reduce | None = None) -> Iterator[ActivationCache]:
    """Capture `sites` while the model runs once.

    reduce: what to keep of a site, called with (site, (B, T, D)) on the device at the moment it fires, such as a
    pooled view; it must return a new tensor. None keeps a copy.
    Raises SiteNeverFiredError or SiteFiredTooOftenError if a site fired another number of times than its
    tap promises, NonFiniteActivationError if a copy holds NaN or infinity, CaptureError if this model
    is being captured already or a tapped module is compiled.
    """
    if model in _captured_now:
        raise CaptureError("this model is being captured already; leave the first capture before the next")
    tape = ActivationCache()

    def keep(site: Site, tap: Tap, passing: Tensor) -> None:
        activation = tap.select(passing).detach()
        tape._kept[site] = activation.clone() if reduce is None else reduce(site, activation)

    with ExitStack() as stack:
        _captured_now.add(model)
        stack.callback(_captured_now.discard, model)
        hooks = _attach(model, sites, keep, stack)
        yield tape
    for hook in hooks:
        hook.check_count()
        tape.fires[hook.name] = hook.promised
    _check_non_finite(tape)


@contextmanager
def edit(model: Model, edits: Mapping[Site, EditFunction]) -> Iterator[None]:
    """Replace activations while the model runs once, at exactly the place where `capture` reads them.

    edits: per site a function from the activation (B, T, D) to its replacement, of the same shape and dtype.
    A capture entered inside this context reads the replacements.
    Raises CaptureError if a replacement has another shape or dtype, and for fires as `capture` does.
    """

    def write(site: Site, tap: Tap, passing: Tensor) -> None:
        activation = tap.select(passing)
        detached = activation.detach() if activation.requires_grad else activation
        new = edits[site](detached.clone())
        if new.shape != activation.shape or new.dtype != activation.dtype:
            raise CaptureError(
                f"the edit of {site} returned {new.dtype} {tuple(new.shape)}; "
                f"expected {activation.dtype} {tuple(activation.shape)}"
            )
        tap.write(passing, new)

    with ExitStack() as stack:
        hooks = _attach(model, edits, write, stack)
        yield
    for hook in hooks:
        hook.check_count()


def _attach(model: Model, sites: Iterable[Site], handle: Handle, stack: ExitStack) -> "list[_CountingHook]":
    """Attach one hook per module; sites that differ only in the iteration share it."""
    groups: dict[tuple[str, int, str], list[Site]] = defaultdict(list)
    for site in dict.fromkeys(sites):
        groups[site.stream, site.layer, site.quantity].append(site)
    hooks = [_CountingHook(model.tap(group[0]), group, handle) for group in groups.values()]
    for hook in hooks:
        stack.callback(hook.attach().remove)
    return hooks


class _CountingHook:
    """A hook that counts the calls of one module and handles those of its sites."""

    def __init__(self, tap: Tap, sites: list[Site], handle: Handle) -> None:
        self.tap, self.first, self.handle = tap, sites[0], handle
        self.at_fire = {site.iteration or 0: site for site in sites}
        self.count = 0

    @property
    def name(self) -> str:
        return str(self.first).partition("@")[0]

    @property
    def promised(self) -> int:
        return self.tap.first + self.tap.fires

    def attach(self) -> RemovableHandle:
        if isinstance(self.tap.module, torch._dynamo.OptimizedModule):
            raise CaptureError(
                f"{self.first} lies in a module compiled by torch.compile, which drops hooks; "
                "load the model uncompiled to capture it"
            )
        if self.tap.end == "output":
            return self.tap.module.register_forward_hook(lambda _, __, output: self._fire(output))
        if self.tap.argument is None:
            return self.tap.module.register_forward_pre_hook(lambda _, inputs: self._fire(inputs))
        return self.tap.module.register_forward_pre_hook(self._fire_with_keyword, with_kwargs=True)

    def _fire_with_keyword(
        self, _module: torch.nn.Module, _inputs: tuple[Any, ...], keywords: dict[str, Any]
    ) -> None:
        if self.tap.argument not in keywords:
            raise CaptureError(
                f"{self.first}: the module is called without the keyword {self.tap.argument!r} the tap names; it "
                f"gets {', '.join(keywords) or 'none'}. Correct the tap"
            )
        self._fire(keywords[self.tap.argument])

    def _fire(self, passing: Any) -> Any:
        site = self.at_fire.get(self.count - self.tap.first)
        self.count += 1
        if site is None:
            return None
        if not isinstance(passing, tuple):
            return self.handle(site, self.tap, passing)
        instead = self.handle(site, self.tap, passing[0])
        return None if instead is None else (instead, *passing[1:])

    def check_count(self) -> None:
        expected = self.promised
        if self.count == expected or (self.tap.more and self.count > expected):
            return
        wrong = SiteNeverFiredError if self.count < expected else SiteFiredTooOftenError
        least = "at least " if self.tap.more else ""
        raise wrong(
            f"{self.first} fired {self.count} times in one inference; expected {least}{expected}. The model does "
            "not call this module the way the adapter declares: correct the tap, or run the model once per context"
        )


def _check_non_finite(tape: ActivationCache) -> None:
    """One question to the device for all sites, not one each: every answer waits for what it has in hand."""
    finite = [torch.isfinite(activation).all() for activation in tape._kept.values()]
    if not finite or bool(torch.stack([flag.to(finite[0].device) for flag in finite]).all()):
        return
    for site, good in zip(tape._kept, finite, strict=True):
        if not good:
            raise NonFiniteActivationError(
                f"{site} holds NaN or infinity; look for overflow (try --dtype float32) or damaged weights"
            )
