"""lerobot's own `PI0Policy` and `PI05Policy`, built at the size a checkpoint has, and names in their files.

lerobot knows two sizes by name and reads no width from `config.json`. Checkpoints of another size carry a
`dims.json`; while such a policy is built, three names inside lerobot's module are replaced, then restored.

The norms of pi0.5's expert are adaptive: the time of the flow step gives each norm a scale, a shift and a gate.
What half a block computes is multiplied by that gate before it is added. lerobot multiplies in a function, so no
module ever holds what is added; here one does. Parameters and results stay lerobot's, bit for bit.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MethodType, ModuleType
from typing import Any, Self, cast

import torch
from lerobot.policies.pi0 import modeling_pi0
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi0.modeling_pi0 import PI0Policy
from lerobot.policies.pi05 import modeling_pi05
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from torch import Tensor, nn

from probe_kit._system.bounded_files import load_json
from probe_kit.models.building import building_device, replaced
from probe_kit.models.config_file import ConfigFile, Count

_VLM = "paligemma_with_expert.paligemma"
# Layout of early-2025 files on the left (lerobot/pi0), today's on the right. Longest prefix first.
_MOVED = (
    (f"{_VLM}.language_model.model.", f"{_VLM}.model.language_model."),
    (f"{_VLM}.language_model.lm_head.", f"{_VLM}.lm_head."),
    (f"{_VLM}.vision_tower.", f"{_VLM}.model.vision_tower."),
    (f"{_VLM}.multi_modal_projector.", f"{_VLM}.model.multi_modal_projector."),
)
_TIME_OF_PI0 = (("time_mlp_in.", "action_time_mlp_in."), ("time_mlp_out.", "action_time_mlp_out."))
_TIME_OF_PI05 = tuple((new, old) for old, new in _TIME_OF_PI0)
# Statistics that old files kept among the weights; today they lie in the processor files.
STATISTICS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.")
LM_HEAD = f"model.{_VLM}.lm_head.weight"
EMBEDDING = f"model.{_VLM}.model.language_model.embed_tokens.weight"


def current_pi0_keys(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors of a pi0 under the names lerobot 0.6 uses."""
    return _renamed(tensors, (*_MOVED, *_TIME_OF_PI0))


def current_pi05_keys(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors of a pi0.5 under the names lerobot 0.6 uses."""
    return _renamed(tensors, (*_MOVED, *_TIME_OF_PI05))


def current_pi0_fast_keys(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same tensors of a pi0-FAST under the names lerobot 0.6 uses."""
    return _renamed(tensors, _MOVED)


def _renamed(tensors: Mapping[str, Tensor], names: Sequence[tuple[str, str]]) -> dict[str, Tensor]:
    return {_current(name, names): tensor for name, tensor in tensors.items() if not name.startswith(STATISTICS)}


def _current(name: str, names: Sequence[tuple[str, str]]) -> str:
    bare = name.removeprefix("model.")
    for old, new in names:
        if bare.startswith(old):
            return f"model.{new}{bare.removeprefix(old)}"
    return f"model.{bare}"


# -- pi0 ------------------------------------------------------------------------------------------------------


class GemmaSize(ConfigFile, extra="forbid"):
    """One Gemma stack. Backbone and expert must agree in depth, KV heads and head size."""

    width: Count
    depth: Count
    mlp_dim: Count
    num_heads: Count
    num_kv_heads: Count
    head_dim: Count


class SiglipSize(ConfigFile, extra="forbid"):
    """The vision tower; `patch` in pixels."""

    hidden: Count
    layers: Count
    heads: Count
    inter: Count
    patch: Count


class SizeFile(ConfigFile):
    """Every dimension that a policy's `config.json` cannot express."""

    @classmethod
    def from_file(cls, path: Path) -> Self:
        """Read `dims.json`. Raises CheckpointError if a dimension is missing, unknown or out of bounds."""
        return cls.read(load_json(path), str(path))

    def to_json(self) -> dict[str, Any]:
        """The content of `dims.json`."""
        return self.model_dump()


class Pi0Size(SizeFile):
    """Every dimension of a pi0 that its `config.json` cannot express."""

    network = "pi0"

    vlm: GemmaSize
    expert: GemmaSize
    vision: SiglipSize
    vocab_size: Count


def build_pi0(config: PI0Config, size: Pi0Size | None = None, device: str = "cpu") -> PI0Policy:
    """A `PI0Policy` in eval mode with uninitialised weights.

    size: None for the released dimensions (Gemma 2B + 300M, SigLIP So400m).
    device: `meta` serves to look at names and shapes. A policy that will act is built on the CPU, because the
    embedding scale and the rotary frequencies are buffers no checkpoint holds.
    """
    device = building_device(device)
    config.device = device
    with resized(modeling_pi0, size), torch.device(device):
        policy = PI0Policy(config)
    policy.eval()
    return cast(PI0Policy, policy)


def full_size_pi0() -> PI0Policy:
    """The released size, on the meta device."""
    return build_pi0(PI0Config(device="cpu"), device="meta")


@contextmanager
def resized(module: ModuleType, size: Pi0Size | None) -> Iterator[None]:
    """Inside, lerobot's module of pi0 or pi0.5 builds networks of this size; None for the released one."""
    if size is None:
        yield
        return
    replacements: dict[str, Callable[..., Any]] = {
        "get_gemma_config": lambda variant: size.vlm if variant == "gemma_2b" else size.expert,
        "PaliGemmaForConditionalGenerationWithPiGemma": sized_paligemma(
            module, size.vlm, size.vision, size.vocab_size
        ),
        "PiGemmaForCausalLM": _sized_expert(module, size),
    }
    with replaced(module, replacements):
        yield


def sized_paligemma(
    module: Any, vlm: GemmaSize, vision: SiglipSize, vocab_size: int, image_side: int | None = None
) -> Callable[..., Any]:
    """A stand-in for lerobot's PaliGemma in `module` while a network of these sizes is built.

    image_side: in pixels, where lerobot leaves it at that of the released tower.
    """
    real = module.PaliGemmaForConditionalGenerationWithPiGemma

    def build(config: Any) -> Any:
        config._vocab_size = vocab_size
        config.text_config.vocab_size = vocab_size
        tower = config.vision_config
        tower.hidden_size = vision.hidden
        tower.num_hidden_layers = vision.layers
        tower.num_attention_heads = vision.heads
        tower.intermediate_size = vision.inter
        tower.patch_size = vision.patch
        tower.projection_dim = vlm.width
        tower.image_size = image_side or tower.image_size
        return real(config=config)

    return build


def _sized_expert(module: Any, size: Pi0Size) -> Callable[..., Any]:
    real = module.PiGemmaForCausalLM

    def build(config: Any) -> Any:
        config.vocab_size = size.vocab_size
        return real(config=config)

    return build


# -- pi0.5 ----------------------------------------------------------------------------------------------------


class Gate(nn.Module):
    """The addition of half a block to the stream: its output, times the gate of the norm in front of it."""

    def forward(self, computed: Tensor, gate: Tensor) -> Tensor:
        """(B, T, D) of (B, T, D) and (B, 1, D)."""
        return computed * gate


def build_pi05(config: PI05Config, size: Pi0Size | None = None, device: str = "cpu") -> PI05Policy:
    """A `PI05Policy` in eval mode with uninitialised weights; see `build_pi0`."""
    device = building_device(device)
    config.device = device
    with resized(modeling_pi05, size), torch.device(device):
        policy = PI05Policy(config)
    policy.eval()
    for block in policy.model.paligemma_with_expert.gemma_expert.model.layers:
        _attach_gates(block)
    return cast(PI05Policy, policy)


def full_size_pi05() -> PI05Policy:
    """The released size, on the meta device."""
    return build_pi05(PI05Config(device="cpu"), device="meta")


def _attach_gates(block: Any) -> None:
    """Give an adaptive block of the expert the modules `attention_gate` and `mlp_gate`."""
    block.attention_gate, block.mlp_gate = Gate(), Gate()
    block.forward = MethodType(_gated_forward, block)


def _gated_forward(block: Any, hidden_states: Tensor, adarms_cond: Tensor, **attention: Any) -> Tensor:
    """(B, T, D): the block's attention, then its MLP, each gated as it is added (arXiv 2504.16054, section IV)."""
    normed, gate = block.input_layernorm(hidden_states, cond=adarms_cond)
    attended, _ = block.self_attn(normed, **attention)
    between = hidden_states + block.attention_gate(attended, gate)
    normed, gate = block.post_attention_layernorm(between, cond=adarms_cond)
    written: Tensor = between + block.mlp_gate(block.mlp(normed), gate)
    return written
