"""Loading of native networks that contain a Qwen vision-language model: from files or seeded random weights."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from probe_kit.errors import UsageError, WeightsError
from probe_kit.hooks.checkpoints.weights import Weights, WeightsAudit, load_weights
from probe_kit.models.initialisation import initialise

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


@dataclass(frozen=True)
class Filled[Network: nn.Module]:
    """A network with its weights, and what loading proved. weights_seed: of a random twin, else None."""

    network: Network
    audit: WeightsAudit
    dtype: str
    weights_seed: int | None


def fill[Network: nn.Module](
    build: Callable[[torch.dtype, str], Network],
    read: Callable[[], Weights],
    dtype: str | None,
    tied: Callable[[Network], tuple[str, ...]],
    name_in_module: Callable[[str], str] = str,
) -> Filled[Network]:
    """The network that `build(dtype, device)` makes, with exactly the weights that `read()` gives.

    dtype: float32 or bfloat16; default that of the tensors in the file. tied: parameters that are another one's
    double, which a file may leave out; called with the network. name_in_module: the network's name of a tensor in
    the file. Raises UsageError for another dtype, WeightsError for weights that are not exactly the network's.
    """
    weights = read()
    name = checked_dtype(dtype or _stored_dtype(weights))
    network = build(DTYPES[name], "meta")
    tensors = {
        name_in_module(key): value.to(DTYPES[name]) if value.is_floating_point() else value
        for key, value in weights.tensors.items()
    }
    if len(tensors) < len(weights.tensors):
        raise WeightsError(f"{weights.source}: two tensors have the same name here; nothing was run")
    audit = load_weights(network, weights, tensors, tied(network), assign=True, name_in_module=name_in_module)
    tie: Any = getattr(network, "vlm", network)
    tie.tie_weights()
    for double in set(tied(network)) & set(tensors):
        if not torch.equal(network.state_dict()[double], tensors[double]):
            raise WeightsError(
                f"{weights.source}: {double} differs from the tensor that config.json ties it to "
                "(tie_word_embeddings); one of the two files is another model's"
            )
    every = {**network.state_dict(), **dict(network.named_buffers())}
    if empty := [key for key, tensor in every.items() if tensor.is_meta]:
        raise WeightsError(f"{weights.source}: {len(empty)} tensors were never filled: {', '.join(empty[:8])}")
    network.requires_grad_(False)
    return Filled(network, audit, name, None)


def twin[Network: nn.Module](
    build: Callable[[torch.dtype, str], Network], checkpoint: str, dtype: str | None, seed: int
) -> Filled[Network]:
    """The same architecture with random weights of `seed`; float32 unless asked otherwise."""
    name = checked_dtype(dtype or "float32")
    network = build(DTYPES[name], "cpu")
    initialise(network, seed)
    weights = Weights(network.state_dict(), f"random twin of {checkpoint}", random=True)
    audit = load_weights(network, weights, weights.tensors)
    network.requires_grad_(False)
    return Filled(network, audit, name, seed)


def checked_dtype(name: str) -> str:
    """`name`, if it is a dtype on offer. Raises UsageError."""
    if name not in DTYPES:
        raise UsageError(f"dtype {name!r} is not one of {', '.join(DTYPES)}")
    return name


def _stored_dtype(weights: Weights) -> str:
    """bfloat16 if every floating tensor of the file is, else float32: nothing is rounded unasked."""
    kinds = {tensor.dtype for tensor in weights.tensors.values() if tensor.is_floating_point()}
    return "bfloat16" if kinds == {torch.bfloat16} else "float32"
