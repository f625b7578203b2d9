"""Loading of native networks: from files or seeded random weights."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

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
    """The network with a Qwen VLM that `build(dtype, device)` makes, with exactly the weights of `read()`.

    dtype: float32 or bfloat16; default that of the tensors in the file. tied: parameters that are another one's
    double, which a file may leave out; called with the network. name_in_module: the network's name of a tensor in
    the file. Raises UsageError for another dtype, WeightsError for weights that are not exactly the network's.
    """
    weights = read()
    name = checked_dtype(dtype or _stored_dtype(weights))
    network = build(DTYPES[name], "meta")
    tensors = as_dtype({name_in_module(key): value for key, value in weights.tensors.items()}, DTYPES[name])
    if len(tensors) < len(weights.tensors):
        raise WeightsError(f"{weights.source}: two tensors have the same name here; nothing was run")
    tying: Any = getattr(network, "vlm", network)
    audit = assign_weights(network, weights, tensors, tied(network), tying.tie_weights, name_in_module)
    network.requires_grad_(False)
    return Filled(network, audit, name, None)


def assign_weights(
    network: nn.Module,
    weights: Weights,
    tensors: Mapping[str, Tensor],
    tied: Collection[str],
    tie: Callable[[], object],
    name_in_module: Callable[[str], str] = str,
) -> WeightsAudit:
    """Make `tensors` the parameters of a network on the meta device.

    tied: parameters that are another one's double, which a file may leave out. tie: ties them again. Raises
    WeightsError for a double with other numbers, for tensors without memory, and what `load_weights` raises.
    """
    audit = load_weights(network, weights, tensors, tied, assign=True, name_in_module=name_in_module)
    tie()
    for double in set(tied) & set(tensors):
        if not torch.equal(network.state_dict()[double], tensors[double]):
            raise WeightsError(
                f"{weights.source}: {double} differs from the tensor that config.json ties it to "
                "(tie_word_embeddings); one of the two files is another model's"
            )
    _check_filled(network, weights.source)
    return audit


def twin[Network: nn.Module](
    build: Callable[[torch.dtype, str], Network], checkpoint: str, dtype: str | None, seed: int
) -> Filled[Network]:
    """The same architecture with random weights of `seed`; float32 unless asked otherwise."""
    name = checked_dtype(dtype or "float32")
    network = build(DTYPES[name], "cpu")
    initialise(network, seed)
    audit = audit_of_twin(network, checkpoint)
    network.requires_grad_(False)
    return Filled(network, audit, name, seed)


def audit_of_twin(network: nn.Module, checkpoint: str) -> WeightsAudit:
    """The audit of a network whose weights were drawn."""
    weights = Weights(network.state_dict(), f"random twin of {checkpoint}", random=True)
    return load_weights(network, weights, weights.tensors)


def as_dtype(tensors: Mapping[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    """The tensors, those of real numbers in `dtype`."""
    return {name: value.to(dtype) if value.is_floating_point() else value for name, value in tensors.items()}


def _check_filled(network: nn.Module, source: str) -> None:
    """Raise WeightsError for tensors and buffers without memory."""
    every = {**network.state_dict(), **dict(network.named_buffers())}
    if empty := [name for name, tensor in every.items() if tensor.is_meta]:
        raise WeightsError(f"{source}: {len(empty)} tensors were never filled: {', '.join(empty[:8])}")


def checked_dtype(name: str) -> str:
    """`name`, if it is a dtype on offer. Raises UsageError."""
    if name not in DTYPES:
        raise UsageError(f"dtype {name!r} is not one of {', '.join(DTYPES)}")
    return name


def _stored_dtype(weights: Weights) -> str:
    """bfloat16 if every floating tensor of the file is, else float32: nothing is rounded unasked."""
    kinds = {tensor.dtype for tensor in weights.tensors.values() if tensor.is_floating_point()}
    return "bfloat16" if kinds == {torch.bfloat16} else "float32"
