"""InternVL's network, built empty from a configuration."""

from typing import Any

import torch
from transformers import InternVLConfig, InternVLForConditionalGeneration

from probe_kit.models.building import build_empty, fill_decoder_rotary
from probe_kit.models.naming import LANGUAGE_FIRST

FILE_NAMES = LANGUAGE_FIRST

_TEXT: dict[str, dict[str, Any]] = {
    "8B": {"hidden_size": 4096, "num_hidden_layers": 36, "num_attention_heads": 32, "intermediate_size": 12288},
    "38B": {"hidden_size": 5120, "num_hidden_layers": 64, "num_attention_heads": 64, "intermediate_size": 25600},
}
_VISION: dict[str, dict[str, Any]] = {
    "8B": {"hidden_size": 1024, "num_hidden_layers": 24, "num_attention_heads": 16, "intermediate_size": 4096,
           "norm_type": "layer_norm", "attention_bias": True, "use_qk_norm": False},
    "38B": {"hidden_size": 3200, "num_hidden_layers": 45, "num_attention_heads": 25, "intermediate_size": 12800,
            "norm_type": "rms_norm", "attention_bias": False, "use_qk_norm": True},
}  # fmt: skip


def build_internvl(config: Any, dtype: torch.dtype, device: str = "meta") -> Any:
    """The network in eval mode; see `build_empty`. Rotary frequencies, which no checkpoint holds, are computed."""
    network: Any = build_empty(lambda: InternVLForConditionalGeneration(config), dtype, device)
    fill_decoder_rotary(network.model.language_model)
    network.tie_weights()
    return network


def full_size_internvl(size: str) -> Any:
    """A released size on the meta device."""
    text = {**_TEXT[size], "model_type": "qwen3", "num_key_value_heads": 8, "head_dim": 128, "vocab_size": 151936}
    vision = {
        **_VISION[size],
        "model_type": "internvl_vision",
        "image_size": [448, 448],
        "patch_size": [14, 14],
        "use_mean_pooling": True,
    }
    config = InternVLConfig(text_config=text, vision_config=vision, tie_word_embeddings=False)
    return build_internvl(config, torch.float32)
