"""lerobot's own `PI0Policy`, built at the size a checkpoint has.

lerobot knows two sizes by name and reads no width from `config.json`. Checkpoints of another size carry a
`dims.json`; while such a policy is built, three names inside lerobot's module are replaced, then restored.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import torch
from lerobot.policies.pi0 import modeling_pi0
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi0.modeling_pi0 import PI0Policy

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError
from probe_kit.models.building import replaced
from probe_kit.models.sizes_only import building_device


@dataclass(frozen=True)
class GemmaSize:
    """One Gemma stack. Backbone and expert must agree in depth, KV heads and head size."""

    width: int
    depth: int
    mlp_dim: int
    num_heads: int
    num_kv_heads: int
    head_dim: int


@dataclass(frozen=True)
class SiglipSize:
    """The vision tower; `patch` in pixels."""

    hidden: int
    layers: int
    heads: int
    inter: int
    patch: int


@dataclass(frozen=True)
class Pi0Size:
    """Every dimension of a pi0 that its `config.json` cannot express."""

    vlm: GemmaSize
    expert: GemmaSize
    vision: SiglipSize
    vocab_size: int

    @classmethod
    def from_file(cls, path: Path) -> "Pi0Size":
        """Read `dims.json`. Raises CheckpointError if a dimension is missing or unknown."""
        values = load_json(path)
        try:
            return cls(
                GemmaSize(**values["vlm"]),
                GemmaSize(**values["expert"]),
                SiglipSize(**values["vision"]),
                int(values["vocab_size"]),
            )
        except (KeyError, TypeError) as error:
            raise CheckpointError(
                f"{path} does not describe a pi0: {error}. Expected vlm, expert, vision and vocab_size "
                f"with the fields of probe_kit.models.lerobot.pi0.Pi0Size."
            ) from error

    def to_json(self) -> dict[str, Any]:
        """The content of `dims.json`."""
        return asdict(self)


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
