"""The network of lerobot's policies on PaliGemma, built at a checkpoint's size, and names in their files.

lerobot knows two sizes by name and reads no width from `config.json`. Checkpoints of another size carry a
`dims.json`; while such a policy is built, three names inside lerobot's module are replaced, then restored.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from probe_kit._system.bounded_files import load_json
from probe_kit.hooks.families.shared.lerobot.normaliser import STATISTICS
from probe_kit.models.building import building_device, replace_attributes
from probe_kit.models.checkpoint_files import SIGLIP_TOWER, rename_tensor, renamed_tensors
from probe_kit.models.config_file import ConfigFile, Count

_VLM = "paligemma_with_expert.paligemma"
# Layout of early-2025 files on the left (lerobot/pi0), today's on the right. Longest prefix first.
PALIGEMMA_NAMES = (
    (f"{_VLM}.language_model.model.", f"{_VLM}.model.language_model."),
    (f"{_VLM}.language_model.lm_head.", f"{_VLM}.lm_head."),
    (f"{_VLM}.vision_tower.", f"{_VLM}.model.vision_tower."),
    (f"{_VLM}.multi_modal_projector.", f"{_VLM}.model.multi_modal_projector."),
)
LM_HEAD = f"model.{_VLM}.lm_head.weight"
EMBEDDING = f"model.{_VLM}.model.language_model.embed_tokens.weight"


def current_keys(
    tensors: Mapping[str, Tensor], names: Sequence[tuple[str, str]] = PALIGEMMA_NAMES
) -> dict[str, Tensor]:
    """Return the same tensors under the names lerobot 0.6 uses; by default those of a pi0-FAST.

    Raises:
        WeightsError: For two different tensors of one name.
    """
    stored = {name: tensor for name, tensor in tensors.items() if not name.startswith(STATISTICS)}
    return renamed_tensors(stored, partial(_current, names=names))


def _current(name: str, names: Sequence[tuple[str, str]]) -> str:
    bare = rename_tensor(name.removeprefix("model."), SIGLIP_TOWER)
    for old, new in names:
        if bare.startswith(old):
            return f"model.{new}{bare.removeprefix(old)}"
    return f"model.{bare}"


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
