"""The quantities that a family compares with a golden reference, from its captures and modules."""

from collections.abc import Callable, Collection, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.hooks.capturing.capture_context import ActivationCache, capture
from probe_kit.hooks.contract.model import Model
from probe_kit.hooks.contract.sites import KV, Site, Stream

Arrays = Mapping[str, NDArray[Any]]
Produce = Callable[[], NDArray[Any]]
_COMPARED = {"residual": "resid", "final_norm": "final_norm"}
"""Endings of the names that references give these quantities."""


@dataclass(frozen=True)
class Outputs:
    """The quantities that a family compares with a golden reference; see `Family.outputs`.

    Attributes:
        produced: The function that makes each quantity, by name; a recorded one that is missing here is listed as
            not compared.
        tolerance: The tolerance of a quantity whose values are below one; larger values may differ by as much of
            the largest one.
        inputs: Recorded names that went in, besides those that begin with `in_`.
        remade: Inputs that the adapter makes too, by the name in `produced`.
        tolerances: The tolerances of single quantities.
        absolute: Quantities whose tolerance is the same for larger values.
        valid: Per quantity a mask over its leading axes behind the first, where only some positions mean anything.
    """

    produced: Mapping[str, Produce]
    tolerance: float = 1e-5
    inputs: Collection[str] = ()
    remade: Mapping[str, str] = field(default_factory=dict)
    tolerances: Mapping[str, float] = field(default_factory=dict)
    absolute: Collection[str] = ()
    valid: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)


@dataclass(frozen=True)
class RecordedRun:
    """The result of one inference on recorded inputs.

    Attributes:
        activations: The activations of every stream.
        calls: The calls of watched modules, see `watch`.
    """

    batch: Mapping[str, Tensor]
    recorded: Arrays
    activations: ActivationCache
    calls: Mapping[str, list[Any]]

    def outputs(self, name: str) -> NDArray[Any]:
        """Return what a watched module put out, stacked over its calls, (calls, …)."""
        return numpy_of(torch.stack(self.calls[name]))


def compared_sites(model: Model) -> list[Site]:
    """Return the residuals and final norms of every stream, and the prompt's keys and values."""
    streams = model.every_stream().values()
    return [
        site
        for stream in streams
        for name in (*_COMPARED, *KV)
        if name in stream.quantities
        for site in stream.sites(name)
    ]


def watch[Result](
    model: Model,
    run: Callable[[], Result],
    modules: Mapping[str, nn.Module] | None = None,
    entered: Mapping[str, nn.Module] | None = None,
) -> tuple[Result, ActivationCache, dict[str, list[Any]]]:
    """Run an inference and capture `compared_sites` and the calls of modules.

    Args:
        model: The model that `run` runs.
        run: Runs one inference.
        modules: The modules whose outputs are listed, by the name of their list; None for none.
        entered: The modules whose positional inputs and keywords are listed; None for none.

    Returns:
        What `run` returns, the activations, and the lists by the name of the module.
    """
    with ExitStack() as stack:
        calls = {name: outputs_of(module, stack) for name, module in (modules or {}).items()}
        calls |= {name: _inputs_of(module, stack) for name, module in (entered or {}).items()}
        activations = stack.enter_context(capture(model, compared_sites(model)))
        result = run()
    return result, activations, calls


def stream_outputs(model: Model, activations: ActivationCache) -> dict[str, Produce]:
    """Return `<stream>_resid` (S, L, B, T, D) and `<stream>_final_norm` (S, B, T, D), and `keys` and `values`.

    S is left out of a stream that runs once.
    """
    produced: dict[str, Produce] = {}
    for name, stream in model.every_stream().items():
        for quantity in (*_COMPARED, *KV):
            if quantity in stream.quantities:
                key = f"{name}_{_COMPARED[quantity]}" if quantity in _COMPARED else quantity
                produced[key] = lambda stream=stream, quantity=quantity: _arrange(activations, stream, quantity)  # type: ignore[misc]
    return produced


def _arrange(activations: ActivationCache, stream: Stream, quantity: str) -> NDArray[Any]:
    values = stack_layers(activations, stream, quantity)
    values = values[:, 0] if quantity == "final_norm" else values
    return values[0] if stream.iterations is None else values


def stack_layers(activations: ActivationCache, stream: Stream, quantity: str = "residual") -> NDArray[Any]:
    """Return (iterations or 1, layers, B, T, D) of one quantity."""
    sites = stream.sites(quantity)
    values = torch.stack([activations[site] for site in sites])
    steps = stream.iterations or 1
    return numpy_of(values.reshape(steps, len(sites) // steps, *values.shape[1:]))


def generation_outputs(model: Any, stream: str, activations: ActivationCache, decoded: Any) -> dict[str, Produce]:
    """Return the quantities of a decoder whose prompt and output tokens are two streams of one stack.

    States are laid out as transformers counts them: the stream at every block, and normed at the end.

    Args:
        model: A model whose stream of the prompt is `backbone` and whose network has a `language_model`.
        stream: Name of the stream of the output tokens.
        activations: The activations of one inference, with `compared_sites`.
        decoded: The decoded tokens: `ids` (B, N) and `logits` (B, N, V).
    """

    def column(name: str, iteration: int | None) -> Tensor:
        """Return the states of one stream, (L+1, 1, positions, D)."""
        blocks = model.streams[name].layers - 1
        layers = [activations[Site(name, layer, iteration=iteration)] for layer in range(blocks)]
        return torch.stack([*layers, activations[Site(name, blocks, "final_norm", iteration)]])

    def states() -> Tensor:
        return torch.cat([column("backbone", None), column(stream, 0)], dim=2)

    @torch.inference_mode()
    def logits() -> NDArray[Any]:
        return numpy_of(model.network.language_model.lm_head(states()[-1]))

    return {
        "hidden_states": lambda: numpy_of(states()),
        "logits": logits,
        "generated_ids": lambda: numpy_of(decoded.ids[0]),
        "generated_step_logits": lambda: numpy_of(decoded.logits[0]),
        "generated_step_hidden": lambda: numpy_of(
            torch.stack([column(stream, step)[:, 0, 0] for step in range(decoded.ids.shape[1])])
        ),
    }


@torch.inference_mode()
def forward_outputs(network: nn.Module, *inputs: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return hidden states (L+1, B, S, D) and logits (B, S, V) of one pass."""
    output = network(*inputs)
    return numpy_of(torch.stack(output.hidden_states)), numpy_of(output.logits)


def pass_outputs(**passes: Callable[[], tuple[NDArray[Any], NDArray[Any]]]) -> dict[str, Produce]:
    """Return `<name>_hidden_states` and `<name>_logits` of passes that return both, each run once."""
    produced: dict[str, Produce] = {}
    for name, run in passes.items():
        once = cache(run)
        produced[f"{name}_hidden_states"] = lambda once=once: once()[0]  # type: ignore[misc]
        produced[f"{name}_logits"] = lambda once=once: once()[1]  # type: ignore[misc]
    return produced


def euler_path(noise: Tensor, velocities: list[Tensor], step: Callable[[Tensor], Tensor]) -> NDArray[Any]:
    """Return (S+1, B, chunk, D): the noise, and the chunk behind every step of the flow."""
    states = [noise]
    for velocity in velocities:
        states.append(states[-1] + step(velocity))
    return numpy_of(torch.stack(states))


def outputs_of(module: nn.Module, stack: ExitStack) -> list[Any]:
    """Return a list that fills with copies of what `module` puts out, until `stack` is left."""
    outputs: list[Any] = []

    def keep(_module: nn.Module, _inputs: object, output: Any) -> None:
        outputs.append(_copy_array(output))

    stack.callback(module.register_forward_hook(keep).remove)
    return outputs


def _inputs_of(module: nn.Module, stack: ExitStack) -> list[Any]:
    """Return a list that fills with copies of positional inputs and keywords, as pairs."""
    inputs: list[Any] = []

    def keep(_module: nn.Module, positional: tuple[Any, ...], keywords: dict[str, Any]) -> None:
        inputs.append(
            (tuple(map(_copy_array, positional)), {name: _copy_array(value) for name, value in keywords.items()})
        )

    stack.callback(module.register_forward_pre_hook(keep, with_kwargs=True).remove)
    return inputs


def _copy_array(value: Any) -> Any:
    return value.detach().clone() if isinstance(value, Tensor) else value


def numpy_of(tensor: Tensor) -> NDArray[Any]:
    """Return an array on the CPU; floating point as float32."""
    return np.asarray(tensor.float().cpu().numpy() if tensor.is_floating_point() else tensor.cpu().numpy())
