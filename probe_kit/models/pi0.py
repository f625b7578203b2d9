"""The policies `PI0Policy` and `PI05Policy` of lerobot, built at a checkpoint's size, and names in their files.

lerobot knows two sizes by name and reads no width from `config.json`. Checkpoints of another size carry a
`dims.json`; while such a policy is built, three names inside lerobot's module are replaced, then restored.

The norms of pi0.5's expert are adaptive: the time of the flow step gives each norm a scale, a shift and a gate.
The output of half a block is multiplied by that gate before it is added. lerobot multiplies in a function, so no
module ever holds the product; here one does. Parameters and results stay lerobot's, bit for bit.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import MethodType
from typing import Any, Self, cast

import torch
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi0.modeling_pi0 import PI0Policy
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from torch import Tensor, nn

from probe_kit._system.bounded_files import load_json
from probe_kit.models.building import Gate, building_device, replace_attributes
from probe_kit.models.checkpoint_files import SIGLIP_TOWER, rename_tensor, renamed_tensors
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


def current_keys(tensors: Mapping[str, Tensor], names: Sequence[tuple[str, str]] = _MOVED) -> dict[str, Tensor]:
    """Return the same tensors under the names lerobot 0.6 uses; by default those of a pi0-FAST.

    Raises:
        WeightsError: For two different tensors of one name.
    """
    stored = {name: tensor for name, tensor in tensors.items() if not name.startswith(STATISTICS)}
    return renamed_tensors(stored, partial(_current, names=names))


current_pi0_keys = partial(current_keys, names=(*_MOVED, *_TIME_OF_PI0))
current_pi05_keys = partial(current_keys, names=(*_MOVED, *_TIME_OF_PI05))


def _current(name: str, names: Sequence[tuple[str, str]]) -> str:
    bare = rename_tensor(name.removeprefix("model."), SIGLIP_TOWER)
    for old, new in names:
        if bare.startswith(old):
            return f"model.{new}{bare.removeprefix(old)}"
    return f"model.{bare}"


# -- pi0 ------------------------------------------------------------------------------------------------------


class GemmaSize(ConfigFile, extra="forbid"):
    """The sizes of a Gemma stack. Backbone and expert must agree in depth, KV heads and head size."""

    width: Count
    depth: Count
    mlp_dim: Count
    num_heads: Count
    num_kv_heads: Count
    head_dim: Count


class SiglipSize(ConfigFile, extra="forbid"):
    """The sizes of the vision tower; `patch` in pixels."""

    hidden: Count
    layers: Count
    heads: Count
    inter: Count
    patch: Count


class PaliGemmaSize(ConfigFile):
    """The dimensions that the `config.json` of a policy on PaliGemma cannot express."""

    network = "pi0-FAST"

    vlm: GemmaSize
    vision: SiglipSize
    vocab_size: Count

    @classmethod
    def from_file(cls, path: Path) -> Self:
        """Read `dims.json`.

        Raises:
            CheckpointError: If a dimension is missing, unknown or out of bounds.
        """
        return cls.read(load_json(path), str(path))

    def to_json(self) -> dict[str, Any]:
        """Return the content of `dims.json`."""
        return self.model_dump()


class Pi0Size(PaliGemmaSize):
    """The same dimensions of a policy with an expert beside it."""

    network = "pi0"

    expert: GemmaSize


def build_resized[Policy: nn.Module](
    policy: Callable[[Any], Policy], config: Any, size: PaliGemmaSize | None, device: str
) -> Policy:
    """Return one of lerobot's policies on PaliGemma in eval mode with uninitialised weights.

    Args:
        policy: Class of the policy.
        config: Its configuration, whose `device` is set.
        size: Dimensions; None for the released ones (Gemma 2B, an expert of 300M, SigLIP So400m).
        device: `meta` serves to look at names and shapes. A policy that will act is built on the CPU, because the
            embedding scale and the rotary frequencies are buffers no checkpoint holds.
    """
    config.device = building_device(device)
    with resize_network(sys.modules[policy.__module__], size, config), torch.device(config.device):
        return policy(config).eval()


def build_pi0(config: PI0Config, size: Pi0Size | None = None, device: str = "cpu") -> PI0Policy:
    """Return a `PI0Policy`; see `build_resized`."""
    return cast(PI0Policy, build_resized(PI0Policy, config, size, device))


def full_size_pi0() -> PI0Policy:
    """Return the released size, on the meta device."""
    return build_pi0(PI0Config(device="cpu"), device="meta")


@contextmanager
def resize_network(module: Any, size: PaliGemmaSize | None, policy_config: Any) -> Iterator[None]:
    """Let lerobot's module of such a policy build networks of this size inside the context.

    None stands for the released size.
    """
    if size is None:
        yield
        return
    paligemma, expert = module.PaliGemmaForConditionalGenerationWithPiGemma, getattr(size, "expert", None)

    def build_paligemma(config: Any) -> Any:
        config._vocab_size = size.vocab_size
        config.text_config.vocab_size = size.vocab_size
        tower = config.vision_config
        tower.hidden_size = size.vision.hidden
        tower.num_hidden_layers = size.vision.layers
        tower.num_attention_heads = size.vision.heads
        tower.intermediate_size = size.vision.inter
        tower.patch_size = size.vision.patch
        tower.projection_dim = size.vlm.width
        tower.image_size = policy_config.image_resolution[0]  # pi0-FAST leaves it at that of the released tower
        return paligemma(config=config)

    replacements: dict[str, Callable[..., Any]] = {
        "get_gemma_config": lambda variant: expert if expert and variant != "gemma_2b" else size.vlm,
        "PaliGemmaForConditionalGenerationWithPiGemma": build_paligemma,
    }
    if expert:
        gemma = module.PiGemmaForCausalLM

        def build_expert(config: Any) -> Any:
            config.vocab_size = size.vocab_size
            return gemma(config=config)

        replacements["PiGemmaForCausalLM"] = build_expert
    with replace_attributes(module, replacements):
        yield


# -- pi0.5 ----------------------------------------------------------------------------------------------------


def build_pi05(config: PI05Config, size: Pi0Size | None = None, device: str = "cpu") -> PI05Policy:
    """Return a `PI05Policy`; see `build_resized`."""
    policy = build_resized(PI05Policy, config, size, device)
    for block in policy.model.paligemma_with_expert.gemma_expert.model.layers:
        _attach_gates(block)
    return cast(PI05Policy, policy)


def full_size_pi05() -> PI05Policy:
    """Return the released size, on the meta device."""
    return build_pi05(PI05Config(device="cpu"), device="meta")


def _attach_gates(block: Any) -> None:
    """Give an adaptive block of the expert the modules `attention_gate` and `mlp_gate`."""
    block.attention_gate, block.mlp_gate = Gate(), Gate()
    block.forward = MethodType(_gated_forward, block)


def _gated_forward(block: Any, hidden_states: Tensor, adarms_cond: Tensor, **attention: Any) -> Tensor:
    """Return the stream (B, T, D) after the block's attention and its MLP.

    The output of each is gated as it is added (arXiv 2504.16054, section IV).
    """
    normed, gate = block.input_layernorm(hidden_states, cond=adarms_cond)
    attended, _ = block.self_attn(normed, **attention)
    between = hidden_states + block.attention_gate(attended, gate)
    normed, gate = block.post_attention_layernorm(between, cond=adarms_cond)
    written: Tensor = between + block.mlp_gate(block.mlp(normed), gate)
    return written
