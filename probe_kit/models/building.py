"""Construction of networks from transformers' and timm's parts without drawing random weights."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import torch
from torch import nn
from torch.overrides import TorchFunctionMode

from probe_kit.models.sizes_only import building_device


def without_precision(values: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration's values without the precision its files are stored in, in its parts too.

    transformers builds every part in the precision its own configuration names, whatever is asked for around it.
    """
    remaining = {name: value for name, value in values.items() if name not in ("dtype", "torch_dtype")}
    return {
        name: without_precision(value) if isinstance(value, dict) else value for name, value in remaining.items()
    }


class _WithoutFilling(TorchFunctionMode):
    """Leave out the drawing of initial weights without memory: it changes nothing, and `clamp_` takes 2 ms."""

    _filling = frozenset({torch.Tensor.uniform_, torch.Tensor.normal_, torch.Tensor.erfinv_, torch.Tensor.clamp_})

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in self._filling and args[0].is_meta:
            return args[0]
        return func(*args, **(kwargs or {}))


def build_empty[Network: nn.Module](
    make: Callable[[], Network], dtype: torch.dtype, device: str = "meta"
) -> Network:
    """Return the network of `make` in eval mode, with parameters of `dtype`; without memory where sizes suffice.

    device: `meta` for parameters that have names and shapes but no memory, to be filled with
    `load_weights(…, assign=True)`; `cpu` for uninitialised weights. The rotary frequencies, which no
    checkpoint holds, are then to be computed, with `fill_decoder_rotary`,
    for Qwen's with `fill_rotary`.
    """
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        with torch.device(building_device(device)), _WithoutFilling():
            network = make()
    finally:
        torch.set_default_dtype(before)
    for name, parameter in network.named_parameters():
        if name.endswith("bias") and not parameter.is_meta:
            nn.init.zeros_(parameter)  # torch would draw them from the global generator
    return network.eval()


def fill_decoder_rotary(decoder: Any) -> None:
    """Compute the rotary frequencies of transformers' decoder on the CPU, in float32 whatever the weights are.

    They are buffers that no checkpoint holds, so a network built on the meta device has none.
    """
    decoder.rotary_emb = type(decoder.rotary_emb)(config=decoder.config)


def fill_rotary(vlm: Any) -> None:
    """Compute the rotary frequencies of a `Qwen…VLForConditionalGeneration`; see `fill_decoder_rotary`.

    Tied output weights are tied again.
    """
    fill_decoder_rotary(vlm.model.language_model)
    visual = vlm.model.visual
    vision = vlm.config.vision_config
    visual.rotary_pos_emb = type(visual.rotary_pos_emb)(vision.hidden_size // vision.num_heads // 2)
    vlm.tie_weights()


@contextmanager
def replaced(module: ModuleType, values: Mapping[str, Any]) -> Iterator[None]:
    """Inside, `module` has `values` under these names; afterwards what it had before, also on an exception."""
    originals = {name: getattr(module, name) for name in values}
    try:
        for name, value in values.items():
            setattr(module, name, value)
        yield
    finally:
        for name, value in originals.items():
            setattr(module, name, value)
