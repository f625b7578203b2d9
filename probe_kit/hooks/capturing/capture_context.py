"""Capture of activations and gradients while a model runs once.

value, slopes = gradients_at(policy, [observation], [seed], policy.sites(), lambda actions: actions[0, :, 1].sum())
slopes["backbone.02.residual"]  # (B, T, D)

A gradient at a site covers every path from the site to the action. At `kv` that is what the acting part reads of a
block. It does not cover what later blocks of the backbone read of the same keys and values: they have read them
before the values pass `kv`.

`torch.nn.TransformerEncoder` computes with fused kernels while no hook is registered in it. With hooks it runs its
submodules, and the rounding differs. `Family.load` switches these kernels off, so that both ways give the same
bits.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from probe_kit._terminal.notebook import rows_html
from probe_kit.errors import (
    CaptureError,
    NonFiniteActivationError,
    SiteFiredTooOftenError,
    SiteNeverFiredError,
    UnknownSiteError,
)
from probe_kit.hooks.capturing.passes import (
    BlockPart,
    PassCapture,
    block_of,
    outside_inference_mode,
    sums_of,
)
from probe_kit.hooks.contract.model import Model, Policy, Tap
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import KV_STREAM, Site

__all__ = [
    "ActivationCache",
    "EditFunction",
    "Reduce",
    "capture",
    "edit",
]


Infer = Callable[[], NDArray[np.float32]]


def switch_off_fused_encoder() -> None:
    """Let every `nn.TransformerEncoder` of this process run its submodules, with and without hooks."""
    torch.backends.mha.set_fastpath_enabled(False)


@contextmanager
def without_fused_encoder() -> Iterator[None]:
    """Let encoders run their submodules inside the body; afterwards the setting is as it was."""
    before = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        yield
    finally:
        torch.backends.mha.set_fastpath_enabled(before)


def reason_of_change(infer: Infer, plain: NDArray[np.float32], infer_captured: Infer) -> str:
    """Return why an inference under capture differs from `plain`, and what to change, as sentences.

    Both inferences are repeated at most once.

    Args:
        infer: The inference without hooks.
        plain: The output of that inference, of any shape.
        infer_captured: The same inference with hooks.
    """
    if not same_bits(infer(), plain):
        return (
            "Without hooks the same inference does not repeat either. The adapter keeps state between calls, or "
            "its model is not deterministic: take all randomness from the seeds, and reset caches at every call"
        )
    with without_fused_encoder():
        repaired = same_bits(infer(), infer_captured())
    if repaired:
        return (
            "The cause is torch's fused encoder: nn.TransformerEncoder computes with other kernels while it has "
            "no hooks. Call torch.backends.mha.set_fastpath_enabled(False) in the loader, or load the model with "
            "probe_kit.hooks.load_model, which does so"
        )
    return (
        "Without hooks the same inference repeats bit for bit. A module computes in another way while it has "
        "hooks, as fused and compiled modules do: switch that off in the loader"
    )


def same_bits(array: NDArray[np.float32], other: NDArray[np.float32]) -> bool:
    """Whether shape, type and bytes are equal; NaN equals itself."""
    return array.shape == other.shape and array.dtype == other.dtype and array.tobytes() == other.tobytes()


# -- the cache ------------------------------------------------------------------------------------------------


class ActivationCache(Mapping[Site, Tensor]):
    """The captured activations of one inference, a mapping from sites in the order in which they fired.

    `activations[site]` is what `capture` kept of it, (B, T, D) on the model's device unless it was reduced. The
    name of a site does as well as the site. The attribute `fires` has, per tap, the number of calls that it
    promises; all of them came.
    """

    def __init__(self) -> None:
        self._kept: dict[Site, Tensor | BlockPart] = {}
        self.fires: dict[str, int] = {}

    def __getitem__(self, site: Site | str) -> Tensor:
        """The activation kept of a site.

        Raises:
            UnknownSiteError: For a site that was not captured or a name that is none.
        """
        captured = Site.parse(site) if isinstance(site, str) else site
        activation = self._kept.get(captured)
        if activation is None:
            raise UnknownSiteError(f"{site} was not captured; the cache holds {self._contents() or 'nothing yet'}")
        if isinstance(activation, BlockPart):
            activation = self._kept[captured] = activation.tensor()
        return activation

    def block(self, sites: Sequence[Site]) -> Tensor:
        """Return what is kept of sites of one shape as one tensor (n, …), in their order.

        Raises:
            UnknownSiteError: For a site that was not captured.
        """
        return block_of([self._kept[site] if site in self._kept else self[site] for site in sites])

    def __iter__(self) -> Iterator[Site]:
        return iter(self._kept)

    def __len__(self) -> int:
        return len(self._kept)

    def __contains__(self, site: object) -> bool:
        try:
            return (Site.parse(site) if isinstance(site, str) else site) in self._kept
        except UnknownSiteError:
            return False

    # Like tensors, caches are compared by identity.
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def get(self, site: Site | str, default: Any = None) -> Any:  # Mapping's own waits for a KeyError
        """The activation, or `default` where the site was not captured."""
        return self[site] if site in self else default  # noqa: SIM401  (this is `get`)

    def stack(self, stream: str, quantity: str = "residual") -> Tensor:
        """Return all of one stream and quantity as one tensor.

        Returns:
            (layers, B, T, D), or (layers, iterations, B, T, D) where sites have iterations; layers and iterations
            ascend, as many as were captured.

        Raises:
            UnknownSiteError: If none was, if a layer lacks an iteration that another has, or if shapes differ.
        """
        sites = sorted(
            (site for site in self._kept if (site.stream, site.quantity) == (stream, quantity)),
            key=lambda site: (site.layer, -1 if site.iteration is None else site.iteration),
        )
        if not sites:
            raise UnknownSiteError(
                f"no site {stream}.….{quantity} was captured; the cache holds {self._contents() or 'nothing yet'}"
            )
        layers = [list(of_layer) for _, of_layer in groupby(sites, key=lambda site: site.layer)]
        iterations = {site.iteration for site in sites}
        incomplete = [of_layer[0].layer for of_layer in layers if len(of_layer) != len(iterations)]
        if incomplete:
            raise UnknownSiteError(
                f"layers {incomplete} of {stream} lack iterations that others have; capture all of "
                f"{len(iterations)} iterations in every layer, or take single sites"
            )
        if len({self._form(site)[0] for site in sites}) > 1:
            raise UnknownSiteError(f"the sites of {stream} have different shapes; take them one by one")
        rows = [torch.stack([self._part(site) for site in of_layer]) for of_layer in layers]
        stacked = torch.stack(rows)
        return stacked[:, 0] if iterations == {None} else stacked

    def _part(self, site: Site) -> Tensor:
        """Return what is kept of a site, which may share memory with what is kept of others."""
        part = self._kept[site]
        return part.settled().of(part.position) if isinstance(part, BlockPart) else part

    def _form(self, site: Site) -> tuple[tuple[int, ...], torch.dtype, torch.device]:
        part = self._part(site)
        return tuple(part.shape), part.dtype, part.device

    def _streams(self) -> list[tuple[str, str, int, int, tuple[int, ...], str]]:
        """Return per stream and quantity: layers, iterations (0: none), shape of a site, dtype and device."""
        by_stream: dict[tuple[str, str], list[Site]] = {}
        for site in self._kept:
            by_stream.setdefault((site.stream, site.quantity), []).append(site)
        return [
            (
                stream, quantity, len({site.layer for site in sites}),
                len({site.iteration for site in sites} - {None}), shape,
                f"{str(dtype).removeprefix('torch.')} on {device}",
            )
            for (stream, quantity), sites in by_stream.items()
            for shape, dtype, device in [self._form(sites[0])]
        ]  # fmt: skip

    def _contents(self) -> str:
        return "; ".join(
            f"{stream}.{quantity}: {layers} layers" + (f" x {iterations} iterations" if iterations else "")
            for stream, quantity, layers, iterations, _, _ in self._streams()
        )

    def __repr__(self) -> str:
        return f"<ActivationCache of {len(self)} sites{': ' if self._kept else ''}{self._contents()}>"

    def _repr_html_(self) -> str:
        rows = [
            (stream, quantity, layers, iterations or "–", " × ".join(map(str, shape)), kind)
            for stream, quantity, layers, iterations, shape, kind in self._streams()
        ]
        columns = ("stream", "quantity", "layers", "iterations", "each (B × T × D)", "")
        note = "cache[site] or cache['backbone.03.residual'] for one of them, cache.stack(stream) for all layers"
        return rows_html(f"ActivationCache of {len(self)} sites", columns, rows, note)


# -- capture --------------------------------------------------------------------------------------------------

Reduce = Callable[[Site, Tensor], Tensor]
EditFunction = Callable[[Tensor], Tensor]
Handle = Callable[[Site, Tap, Tensor], Tensor | None]
"""A function of a site, its tap and the tensor that passes there.

A tensor that it returns passes on in place of the input, and None leaves the input. Where the tap reads a keyword
of the call, the tensor is only read.
"""
_captured_now: "WeakKeyDictionary[Model, PassCapture | None]" = WeakKeyDictionary()
"""The models that are being captured, each with the passes that wait; None where a function reduces at once."""
_attached_now: set[int] = set()
"""The ids of the hooks of all captures and edits."""


@contextmanager
def capture(
    model: Model, sites: Iterable[Site], reduce: Reduce | None = None, most_bytes: int | None = None
) -> Iterator[ActivationCache]:
    """Capture `sites` while the model runs once.

    Args:
        model: The model that runs inside the context.
        sites: The sites to capture; each is captured once, however often it is named.
        reduce: Gives what to keep of a site, such as a pooled view. It is called with (site, (B, T, D)) on the
            device at the moment the site fires, and must return a new tensor. None keeps a copy.
        most_bytes: Without `reduce`, the largest size of the tensors that wait until their pass is copied as a
            whole. None waits for all layers of one iteration of a stream.

    What is kept can be trained on: although policies infer in `torch.inference_mode`, it is no inference tensor,
    which torch refuses to train on, and carries no gradient. `reduce` runs outside that mode too.

    Raises:
        SiteNeverFiredError: If a site fired less often than its tap promises.
        SiteFiredTooOftenError: If a site fired more often than its tap promises.
        NonFiniteActivationError: If a copy holds NaN or infinity.
        CaptureError: If this model is being captured already or a tapped module is compiled.
    """
    cache = ActivationCache()
    if reduce is None:
        passes = PassCapture(model, None, {}, cache._kept, most_bytes)
        with _capture(model, sites, cache, passes.fire, passes):
            yield cache
        return
    kept_of = reduce

    def keep(site: Site, tap: Tap, passing: Tensor) -> None:
        activation = tap.select(passing).detach()
        if torch.is_inference_mode_enabled():  # torch refuses to train on tensors that are made in it
            with torch.inference_mode(False), torch.no_grad():
                cache._kept[site] = kept_of(site, activation)
        else:
            cache._kept[site] = kept_of(site, activation)

    with _capture(model, sites, cache, keep, None):
        yield cache


@dataclass(frozen=True)
class CapturedViews:
    """The pooled views of one inference, and its tokens where they are kept.

    Attributes:
        views: (B, V, D) float32 per site.
        tokens: (B, T, D) per site; empty if only views are kept.
    """

    views: ActivationCache
    tokens: ActivationCache


@contextmanager
def capture_views(
    model: Model,
    sites: Iterable[Site],
    weights: Mapping[str, Tensor],
    with_tokens: bool = False,
    most_bytes: int | None = None,
) -> Iterator[CapturedViews]:
    """Capture pooled views of sites while the model runs once, by one product for all layers of a pass.

    Args:
        model: The model that runs inside the context.
        sites: The sites to capture.
        weights: By stream the weights (B, V, T) float32 of `pool_weights`, on the model's device.
        with_tokens: Whether every token is kept as well.
        most_bytes: The largest size of the tensors that wait until their pass is pooled, with their copies. None
            waits for all layers of one iteration of a stream.

    Raises:
        RolesMismatchError: For weights of another number of rows or tokens, and what `capture` raises.
    """
    captured = CapturedViews(ActivationCache(), ActivationCache())
    tokens = captured.tokens._kept if with_tokens else None
    passes = PassCapture(model, weights, captured.views._kept, tokens, most_bytes)
    with _capture(model, sites, captured.views, passes.fire, passes):
        yield captured
    captured.tokens.fires = captured.views.fires
    _check_non_finite(captured.tokens)


@contextmanager
def _capture(
    model: Model, sites: Iterable[Site], cache: ActivationCache, keep: Handle, passes: PassCapture | None
) -> Iterator[None]:
    """Capture with one handle; afterwards check the counts and, in `cache`, that every number is finite."""
    if model in _captured_now:
        raise CaptureError("this model is being captured already; leave the first capture before the next")
    with ExitStack() as stack:
        _captured_now[model] = passes
        stack.callback(_captured_now.pop, model, None)
        hooks = _attach(model, sites, keep, stack)
        if passes is not None:
            passes.arrange(((hook.tap, hook.at_fire) for hook in hooks), _attached_now)
        yield
    for hook in hooks:
        hook.check_count()
        cache.fires[hook.name] = hook.promised
    _check_non_finite(cache)
    if passes is not None:
        passes.learn()


@contextmanager
def edit(model: Model, edits: Mapping[Site, EditFunction]) -> Iterator[None]:
    """Replace activations while the model runs once, at exactly the place where `capture` reads them.

    A capture entered inside this context reads the replacements.

    Args:
        model: The model that runs inside the context.
        edits: Per site a function from the activation (B, T, D) to its replacement, of the same shape and dtype.

    Raises:
        CaptureError: If a replacement has another shape or dtype, and for fires as `capture` does.
    """
    if (passes := _captured_now.get(model)) is not None:
        passes.copy_at_once()

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
    compiled = partial(compiled_parts, model)
    hooks = [_CountingHook(model.tap(group[0]), group, handle, compiled) for group in groups.values()]
    for hook in hooks:
        attached = hook.attach()
        _attached_now.add(attached.id)
        stack.callback(_attached_now.discard, attached.id)
        stack.callback(attached.remove)
    return hooks


def compiled_parts(model: Model) -> list[str]:
    """Return the names of compiled modules and functions in a model's networks, such as `model.denoise_step`.

    They were compiled by `torch.compile`, `Module.compile` or `torch.jit`. A compiled function that no module has
    as an attribute, such as a global one, cannot be recognised.
    """
    networks = {name: part for name, part in vars(model).items() if isinstance(part, nn.Module)}
    compiled: list[str] = []
    for network in networks.values():
        for path, module in network.named_modules():
            prefix = f"{path}." if path else ""
            if _is_compiled(module):
                compiled.append(path or type(module).__name__)
            compiled += [f"{prefix}{name}" for name, value in vars(module).items() if _is_compiled(value)]
            compiled += [f"{prefix}{name}" for name, value in vars(type(module)).items() if _is_compiled(value)]
    return list(dict.fromkeys(compiled))


def _is_compiled(part: object) -> bool:
    """Whether torch compiled this module or function."""
    if isinstance(part, nn.Module):
        is_script = isinstance(part, torch.jit.ScriptModule)
        return is_script or isinstance(part, torch._dynamo.OptimizedModule) or part._compiled_call_impl is not None
    return hasattr(part, "_torchdynamo_orig_callable") or isinstance(part, torch.jit.ScriptFunction)


class _CountingHook:
    """A hook that counts the calls of one module and handles those of its sites."""

    def __init__(self, tap: Tap, sites: list[Site], handle: Handle, compiled: Callable[[], Sequence[str]]) -> None:
        self.tap, self.first, self.handle, self.compiled = tap, sites[0], handle, compiled
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
        counts = f"{self.first} fired {self.count} times in one inference; expected {least}{expected}."
        if self.count < expected and (compiled := self.compiled()):
            raise wrong(
                f"{counts} Compiled by torch.compile or torch.jit: {', '.join(compiled[:3])}. Compiled code calls "
                "no hook that is attached after its first run: load the model uncompiled to capture it"
            )
        raise wrong(
            f"{counts} The model does not call this module the way the adapter declares: correct the tap, or run "
            "the model once per context"
        )


def _check_non_finite(cache: ActivationCache) -> None:
    """Check that every kept activation is finite.

    One question goes to the device for all sites, not one each: every answer waits for the work in its queue.

    Raises:
        NonFiniteActivationError: For the first site that holds NaN or infinity.
    """
    if not cache._kept:
        return
    with outside_inference_mode():
        sums = sums_of(cache._kept.values())
        on_one = [number if number.device == sums[0].device else number.to(sums[0].device) for number in sums]
        if np.isfinite(torch.stack(on_one).tolist()).all():
            return
        for site in cache._kept:
            if not bool(torch.isfinite(cache._part(site)).all()):
                raise NonFiniteActivationError(
                    f"{site} holds NaN or infinity; look for overflow (try --dtype float32) or damaged weights"
                )


# -- gradients ------------------------------------------------------------------------------------------------

Metric = Callable[[Tensor], Tensor]
"""A function from actions (B, chunk, 7), in metres and radians, to a number."""


def gradients_at(
    policy: Policy,
    observations: Sequence[Observation],
    seeds: Sequence[int],
    sites: Iterable[Site],
    metric: Metric,
) -> tuple[float, ActivationCache]:
    """Return the metric of one inference, and its gradient at every site.

    The gradients are (B, T, D) float32, zero where nothing reads the site. Costs about three inferences, however
    many sites.

    Args:
        policy: A policy of a family that declares gradients.
        observations: The B rows of the inference.
        seeds: One seed per observation.
        sites: The sites whose gradients are wanted.
        metric: The number of the actions (B, chunk, 7) whose gradient is taken.

    Raises:
        UnsupportedInterventionError: For a family that does not declare gradients, and what `capture` raises.
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
        """Return the gradient of a number at every site, and free the graph."""
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
    an output, and of `kv`, a copy passes on: a later layer that adds to the copy in place does not change the kept
    tensor. A module that read the tensor before the hook has no part in its gradient. The first tensor of all
    becomes a leaf: nothing above it is kept.
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
def freeze_weights(network: nn.Module) -> Iterator[None]:
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
