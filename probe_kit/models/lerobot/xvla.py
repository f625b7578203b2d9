"""lerobot's own `XVLAPolicy` at the size a checkpoint has, and its denoising from noise that is given.

lerobot's `predict_action_chunk` ignores the noise it is given and draws its own for a whole batch at once.
`denoised_actions` calls the same modules with noise that is given.

Source: arXiv 2510.10274, through lerobot's `XVLAPolicy`.
"""

from collections.abc import Mapping
from typing import Any, cast

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.xvla.configuration_xvla import XVLAConfig
from lerobot.policies.xvla.modeling_xvla import (
    XVLAPolicy,
    _is_vendored_florence_state_dict,
    _remap_vendored_florence_state_dict,
)
from torch import Tensor

from probe_kit.models.building import build_empty
from probe_kit.models.sizes_only import building_device

_LANGUAGE = "model.vlm.language_model."
EMBEDDINGS = (f"{_LANGUAGE}shared.weight", f"{_LANGUAGE}encoder.embed_tokens.weight")
"""One tensor under two names, of which a file may hold either."""
FLORENCE_LARGE: dict[str, Any] = {
    "vision_config": {
        "embed_dim": [256, 512, 1024, 2048],
        "num_heads": [8, 16, 32, 64],
        "num_groups": [8, 16, 32, 64],
        "projection_dim": 1024,
    },
    "text_config": {
        "vocab_size": 51289,
        "d_model": 1024,
        "encoder_layers": 12,
        "encoder_attention_heads": 16,
        "encoder_ffn_dim": 4096,
        "max_position_embeddings": 4096,
    },
}
"""Florence-2 large, the backbone that the paper names; the rest as transformers has it by default."""


def build_xvla(config: XVLAConfig, device: str = "cpu") -> XVLAPolicy:
    """A `XVLAPolicy` in eval mode with uninitialised weights, in the precision that `config` names."""
    device = building_device(device)
    config.device = device
    dtype = torch.bfloat16 if config.dtype == "bfloat16" else torch.float32
    return cast(XVLAPolicy, build_empty(lambda: XVLAPolicy(config), dtype, device))


def full_size_xvla() -> XVLAPolicy:
    """Florence-2 large under lerobot's default transformer, on the meta device."""
    config = XVLAConfig(
        device="cpu",
        florence_config=FLORENCE_LARGE,
        input_features={
            "observation.images.image": PolicyFeature(FeatureType.VISUAL, (3, 224, 224)),
            "observation.state": PolicyFeature(FeatureType.STATE, (20,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (20,))},
    )
    return build_xvla(config, device="meta")


def current_xvla_keys(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A file's tensors under the names lerobot's network has.

    Files of 2025 have Florence-2 in its authors' layout.
    """
    stored = dict(tensors)
    return _remap_vendored_florence_state_dict(stored) if _is_vendored_florence_state_dict(stored) else stored


def denoised_actions(policy: Any, inputs: Mapping[str, Tensor], noise: Tensor) -> Tensor:
    """(B, chunk, D) actions from noise (B, chunk, widest action): lerobot's denoising, one inference.

    inputs: in lerobot's keys. The network predicts actions, not a velocity: every step mixes them with the noise.
    """
    model, steps = policy.model, max(1, int(policy.config.num_denoising_steps))
    model_inputs = policy._build_model_inputs(dict(inputs))
    dtype = model._get_target_dtype()
    proprio, noise = model_inputs["proprio"].to(dtype), noise.to(dtype)
    prompt = model.forward_vlm(
        model_inputs["input_ids"], model_inputs["image_input"].to(dtype), model_inputs["image_mask"]
    )
    actions = torch.zeros_like(noise)
    for remaining in range(steps, 0, -1):
        time = torch.full((len(noise),), remaining / steps, device=noise.device, dtype=dtype)
        share = time.view(-1, 1, 1)
        state, noisy = model.action_space.preprocess(proprio, noise * share + actions * (1 - share))
        actions = model.transformer(
            domain_id=model_inputs["domain_id"], action_with_noise=noisy, proprio=state, t=time, **prompt
        )
    return cast(Tensor, model.action_space.postprocess(actions))
