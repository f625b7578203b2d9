"""The language model in 8 or 4 bits through bitsandbytes: for small GPUs; numbers are not exact."""

from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from probe_kit._system.optional_dependencies import require
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from probe_kit.models.prismatic import PrismaticNetwork


def check_quantisation(bits: int, device: str) -> None:
    """Refuse before anything large is read. Raises UsageError or MissingExtraError."""
    if bits not in (8, 4):
        raise UsageError(f"bits is {bits}; expected 8 or 4")
    require("bitsandbytes", "quantized")
    if not device.startswith("cuda") or not torch.cuda.is_available():
        raise UsageError(
            f"{bits}-bit weights need an NVIDIA GPU and --device cuda; device is {device!r} and CUDA is "
            f"{'available' if torch.cuda.is_available() else 'not available'}. Leave -M bits out to run exactly"
        )


def quantise(network: "PrismaticNetwork", bits: int) -> None:
    """Replace every linear layer inside the decoder's blocks; they are packed when they move to the GPU.

    Towers, projector, embeddings and the output head keep their weights.
    """
    library = require("bitsandbytes", "quantized")
    for block in network.language_model.model.layers:
        for name, linear in [(n, m) for n, m in block.named_modules() if isinstance(m, nn.Linear)]:
            parent, _, child = name.rpartition(".")
            setattr(block.get_submodule(parent), child, _packed(library.nn, linear, bits))


def _packed(layers: Any, linear: nn.Linear, bits: int) -> nn.Module:
    sizes, bias = (linear.in_features, linear.out_features), linear.bias is not None
    packed: nn.Module
    if bits == 8:
        packed = layers.Linear8bitLt(*sizes, bias=bias, has_fp16_weights=False, threshold=6.0)
        packed.weight = layers.Int8Params(linear.weight.data, requires_grad=False, has_fp16_weights=False)
    else:
        packed = layers.Linear4bit(*sizes, bias=bias, compute_dtype=linear.weight.dtype, quant_type="nf4")
        packed.weight = layers.Params4bit(linear.weight.data, requires_grad=False, quant_type="nf4")
    packed.bias = linear.bias
    return packed
