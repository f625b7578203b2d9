"""The construction of networks: empty ones, sizes without numbers, initial weights, parts that networks share."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from probe_kit.errors import CheckpointError

_SIZES_ONLY = ContextVar("sizes_only", default=False)


@contextmanager
def sizes_only() -> Iterator[None]:
    """Build networks on the meta device inside this context, and neither fill nor read them."""
    token = _SIZES_ONLY.set(True)
    try:
        with torch.device("meta"):
            yield
    finally:
        _SIZES_ONLY.reset(token)


def builds_sizes_only() -> bool:
    """Whether networks are built for their sizes alone."""
    return _SIZES_ONLY.get()


def building_device(device: str = "cpu") -> str:
    """Return the device on which a network without numbers of its own is built: `device`, or meta for sizes."""
    return "meta" if builds_sizes_only() else device


# -- initial weights ------------------------------------------------------------------------------------------


@torch.no_grad()
def initialise(network: nn.Module, seed: int) -> None:
    """Fill every parameter with random numbers of a scale that keeps activations of order one.

    Matrices are N(0, 1/fan_in), residual outputs half of that, embeddings 1/sqrt(width), position embeddings 0.5,
    biases zero, norms untouched. Numbers are drawn by numpy in name order, so that a seed means the same bits on
    every machine.
    """
    if builds_sizes_only():
        return
    rng = np.random.Generator(np.random.PCG64(seed))
    residual_outputs = ("o_proj.weight", "out_proj.weight", "down_proj.weight", "fc2.weight")
    for name, parameter in sorted(network.named_parameters()):
        if parameter.ndim < 2:
            if name.endswith("bias"):
                parameter.zero_()  # torch draws them from its global generator
            continue
        scale = 1 / float(np.sqrt(parameter[0].numel()))
        if "position_embedding" in name or "pos_embed" in name:
            scale = 0.5
        elif name.endswith(residual_outputs):
            scale /= 2
        values = rng.standard_normal(tuple(parameter.shape), dtype=np.float32) * np.float32(scale)
        parameter.copy_(torch.from_numpy(values))


# -- parts of networks ----------------------------------------------------------------------------------------


def frequencies(count: int, longest: float) -> Tensor:
    """Return angular frequencies (count,) float32 on the CPU, geometrically from 1 down to nearly 1 / `longest`.

    The exponents are float32, as in the original implementations. Their exponential is rounded correctly: that of
    torch differs in the last bit between versions and processors, and a time of 600 multiplies this error by 600.
    """
    exponents = -math.log(longest) * torch.arange(count, dtype=torch.float32) / count
    return torch.exp(exponents.double()).float()


_SINUSOID, _LONGEST_PERIOD = 256, 10000


class TimeEmbedder(nn.Module):
    """The embedding of a moment of a flow, or of a step of a diffusion, as a vector."""

    def __init__(self, width: int, bias: bool) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(_SINUSOID, width, bias=bias), nn.SiLU(), nn.Linear(width, width, bias=bias)
        )

    def forward(self, moments: Tensor) -> Tensor:
        """Return the embeddings (B, D) of (B,) numbers; cosines stand before sines."""
        angles = moments[:, None].float() * frequencies(_SINUSOID // 2, _LONGEST_PERIOD).to(moments.device)
        sinusoid = torch.cat([angles.cos(), angles.sin()], dim=-1)
        # The released models round the sinusoid to the precision of their weights.
        return cast(Tensor, self.mlp(sinusoid.to(next(self.mlp.parameters()).dtype)))


class Gate(nn.Module):
    """A factor on the output of half a block; a module, so that hooks can capture what is added to the stream."""

    def forward(self, computed: Tensor, gate: Tensor) -> Tensor:
        """Return `computed` (B, T, D) times `gate` (B, 1, D)."""
        return computed * gate


def without_precision(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration's values without the precision in which its files are stored, also in its parts.

    transformers builds every part in the precision its own configuration names, whatever is asked for around it.
    """
    remaining = {name: value for name, value in values.items() if name not in ("dtype", "torch_dtype")}
    return {
        name: without_precision(value) if isinstance(value, dict) else value for name, value in remaining.items()
    }


class WithoutFilling(TorchFunctionMode):
    """A context in which constructors draw no initial matrices.

    A checkpoint or `initialise` fills every matrix afterwards, and torch draws on one core: two thirds of the time
    that a policy of lerobot takes to load. On the meta device `clamp_` alone takes 2 ms.
    """

    # By name: torch hands functions of `nn.init` over whole, and transformers puts wrappers in their places.
    _filling = frozenset({"uniform_", "normal_", "kaiming_uniform_", "erfinv_", "clamp_"})

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        # Vectors are left to torch: `initialise` keeps those of norms.
        if getattr(func, "__name__", "") in self._filling:
            filled: Tensor = args[0] if args else kwargs["tensor"]
            if filled.is_meta or filled.ndim >= 2:
                return filled
        return func(*args, **(kwargs or {}))


_FACTORIES = frozenset({"empty", "zeros", "ones", "full", "rand", "randn"})
_SPARE = 1 << 26
"""Numbers that a network may have beyond its weights: buffers, and what tiny checkpoints build and drop again."""


class LimitedSize(TorchFunctionMode):
    """A context in which no network is built that its weights could never fill.

    Where a configuration lacks a part, transformers takes the sizes of a class, often those of a released model: a
    checkpoint of a megabyte would fill the memory before its weights are compared with its network.
    """

    def __init__(self, folder: Path, weight_bytes: int) -> None:
        """Limit the numbers of a network.

        Args:
            folder: The folder of the checkpoint, for messages.
            weight_bytes: Size of the files of its weights, in bytes.
        """
        super().__init__()
        self._folder, self._weight_bytes = folder, weight_bytes
        self._built = 0

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        options = kwargs or {}
        if getattr(func, "__name__", "") in _FACTORIES:
            self._built += func(*args, **{**options, "device": "meta"}).numel()
            if self._built > self._weight_bytes + _SPARE:
                raise CheckpointError(
                    f"{self._folder}: its configuration describes a network of more than {self._built:,} numbers, "
                    f"and its weights have {self._weight_bytes:,} bytes. A part of the configuration is missing, "
                    "or belongs to another checkpoint. Download its JSON files again"
                )
        return func(*args, **options)


def build_empty[Network: nn.Module](
    make: Callable[[], Network], dtype: torch.dtype, device: str = "meta"
) -> Network:
    """Return the network of `make` in eval mode, with parameters of `dtype`; without memory where sizes suffice.

    Args:
        make: Function that builds the network.
        dtype: Type of the parameters.
        device: `meta` for parameters that have names and shapes but no memory, to be filled with `load_weights(…,
            assign=True)`; `cpu` for uninitialised weights. The rotary frequencies, which no checkpoint holds, are
            then to be computed, with `fill_decoder_rotary`, for Qwen's with `fill_rotary`.
    """
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        with torch.device(building_device(device)), WithoutFilling():
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


_VISION_THETA = 10000.0
"""The base of the rotary frequencies in the vision towers of Qwen, a constant of the installed transformers."""


def fill_rotary(vlm: Any) -> None:
    """Compute the rotary frequencies of a `Qwen…VLForConditionalGeneration`; see `fill_decoder_rotary`.

    Tied output weights are tied again.

    Raises:
        CheckpointError: For a tower with other frequencies, which newer transformers than the installed one read.
    """
    fill_decoder_rotary(vlm.model.language_model)
    visual = vlm.model.visual
    vision = vlm.config.vision_config
    stored = (getattr(vision, "rope_parameters", None) or {}).get("rope_theta", _VISION_THETA)
    if stored != _VISION_THETA:
        raise CheckpointError(
            f"the configuration has rope_theta {stored} in vision_config.rope_parameters; the installed "
            f"transformers runs this tower with {_VISION_THETA:g} alone. Take a checkpoint with that"
        )
    visual.rotary_pos_emb = type(visual.rotary_pos_emb)(vision.hidden_size // vision.num_heads // 2)
    vlm.tie_weights()


@contextmanager
def replace_attributes(module: ModuleType, values: Mapping[str, Any]) -> Iterator[None]:
    """Give `module` these values under their names inside the context, and restore its own ones afterwards.

    They are restored also on an exception.
    """
    originals = {name: getattr(module, name) for name in values}
    try:
        for name, value in values.items():
            setattr(module, name, value)
        yield
    finally:
        for name, value in originals.items():
            setattr(module, name, value)
