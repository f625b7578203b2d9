"""lerobot's own `PI0Policy`, built at the size a checkpoint has.

lerobot knows two sizes by name and reads no width from `config.json`. Checkpoints of another size carry a
`dims.json`; while such a policy is built, three names inside lerobot's module are replaced, then restored.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, Self, cast

import torch
from lerobot.policies.pi0 import modeling_pi0
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi0.modeling_pi0 import PI0Policy

from probe_kit._system.bounded_json import load_json
from probe_kit.models.building import replaced
from probe_kit.models.config_file import ConfigFile, Count
from probe_kit.models.sizes_only import building_device


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
