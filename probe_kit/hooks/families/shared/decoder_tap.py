"""The taps of a decoder of pre-norm blocks, for every family that has one."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from torch import nn

from probe_kit.hooks.contract.model import EVERY, Tap
from probe_kit.hooks.contract.sites import HEADS, Site

_PROJECTIONS = ("o_proj", "out_proj", "attn_out", "dense")
"""Names that networks give to the output projection of an attention."""


def decoder_tap(
    layers: Sequence[Any],
    norm: nn.Module,
    site: Site,
    fires: int = 1,
    tokens: slice = EVERY,
    entry: str = "input_layernorm",
    added: Mapping[str, str] = MappingProxyType({}),
) -> Tap:
    """Return the tap of a site: the first norm of the block it enters, the final norm, or a block's output.

    norm: behind the last block. fires, tokens: of the `Tap`. entry: name of the block's first submodule. added:
    by quantity, the submodule whose output a block adds, where it is neither the MLP nor the output projection.
    """
    if site.quantity == "final_norm":
        return Tap(norm, fires, "output", tokens)
    if site.layer == len(layers):  # behind the last block: what the final norm reads
        return Tap(norm, fires, tokens=tokens)
    block = layers[site.layer]
    if site.quantity == HEADS:
        return Tap(output_projection(block.self_attn), fires, tokens=tokens)
    if site.quantity in added:
        return Tap(getattr(block, added[site.quantity]), fires, "output", tokens)
    if site.quantity == "mlp":
        return Tap(block.mlp, fires, "output", tokens)
    if site.quantity == "attention":
        return Tap(output_projection(block.self_attn), fires, "output", tokens)
    return Tap(getattr(block, entry), fires, tokens=tokens)


def output_projection(attention: Any) -> Any:
    """Return the output projection of an attention of a language model or a vision tower."""
    return next(getattr(attention, name) for name in _PROJECTIONS if hasattr(attention, name))
