"""Qwen2.5-VL and Qwen3-VL at their released sizes, built empty, on transformers' own classes."""

from typing import Any

import torch
from transformers import (
    Qwen2_5_VLConfig,
    Qwen2_5_VLForConditionalGeneration,
    Qwen3VLConfig,
    Qwen3VLForConditionalGeneration,
)

from probe_kit.models.building import build_empty, fill_rotary
from probe_kit.models.naming import Renames

QWEN2_5_NAMES: Renames = (
    (r"^visual\.", "model.visual."),
    (r"^model\.(?!language_model\.|visual\.)", "model.language_model."),
)
"""Qwen2.5-VL was released under names that transformers has changed since."""

_QWEN2_5: dict[str, dict[str, Any]] = {
    "7B": {"hidden_size": 3584, "num_hidden_layers": 28, "num_attention_heads": 28, "num_key_value_heads": 4,
           "intermediate_size": 18944, "vocab_size": 152064},
    "32B": {"hidden_size": 5120, "num_hidden_layers": 64, "num_attention_heads": 40, "num_key_value_heads": 8,
            "intermediate_size": 27648, "vocab_size": 152064},
    "3B": {"hidden_size": 2048, "num_hidden_layers": 36, "num_attention_heads": 16, "num_key_value_heads": 2,
           "intermediate_size": 11008, "vocab_size": 151936},
}  # fmt: skip
_QWEN2_5_MLP = {"7B": 3420, "32B": 3456, "3B": 3420}
_TIED = frozenset({"3B", "4B"})
_QWEN3: dict[str, dict[str, Any]] = {
    "8B": {"hidden_size": 4096, "num_hidden_layers": 36, "num_attention_heads": 32, "intermediate_size": 12288},
    "32B": {"hidden_size": 5120, "num_hidden_layers": 64, "num_attention_heads": 64, "intermediate_size": 25600},
    "4B": {"hidden_size": 2560, "num_hidden_layers": 36, "num_attention_heads": 32, "intermediate_size": 9728},
}
_QWEN3_VISION: dict[str, Any] = {
    "depth": 27,
    "hidden_size": 1152,
    "intermediate_size": 4304,
    "num_heads": 16,
    "deepstack_visual_indexes": [8, 16, 24],
}
_QWEN3_SMALL_VISION: dict[str, Any] = {
    "depth": 24,
    "hidden_size": 1024,
    "intermediate_size": 4096,
    "num_heads": 16,
    "deepstack_visual_indexes": [5, 11, 17],
}


def build_qwen2_5_vl(config: Any, dtype: torch.dtype, device: str = "meta") -> Any:
    """The network in eval mode; see `build_empty`."""
    return _built(lambda: Qwen2_5_VLForConditionalGeneration(config), dtype, device)


def build_qwen3_vl(config: Any, dtype: torch.dtype, device: str = "meta") -> Any:
    """The network in eval mode; see `build_empty`."""
    return _built(lambda: Qwen3VLForConditionalGeneration(config), dtype, device)


def _built(make: Any, dtype: torch.dtype, device: str) -> Any:
    network = build_empty(make, dtype, device)
    fill_rotary(network)
    return network


def qwen2_5_vl_config(size: str) -> Qwen2_5_VLConfig:
    """Return the configuration of a released size."""
    text = {**_QWEN2_5[size], "rope_scaling": {"type": "mrope", "mrope_section": [16, 24, 24]}}
    vision = {
        "depth": 32,
        "hidden_size": 1280,
        "intermediate_size": _QWEN2_5_MLP[size],
        "num_heads": 16,
        "out_hidden_size": text["hidden_size"],
        "patch_size": 14,
        "window_size": 112,
        "fullatt_block_indexes": [7, 15, 23, 31],
    }
    tied = size in _TIED
    return Qwen2_5_VLConfig(text_config=text, vision_config=vision, tie_word_embeddings=tied)


def full_size_qwen2_5_vl(size: str) -> Any:
    """A released size on the meta device."""
    return build_qwen2_5_vl(qwen2_5_vl_config(size), torch.float32)


def full_size_qwen3_vl(size: str) -> Any:
    """A released size on the meta device."""
    text = {
        **_QWEN3[size],
        "num_key_value_heads": 8,
        "head_dim": 128,
        "vocab_size": 151936,
        "rope_parameters": {
            "rope_type": "default",
            "rope_theta": 5000000.0,
            "mrope_section": [24, 20, 20],
            "mrope_interleaved": True,
        },
    }
    tied = size in _TIED
    vision_sizes = _QWEN3_SMALL_VISION if tied else _QWEN3_VISION
    vision = {**vision_sizes, "out_hidden_size": text["hidden_size"], "patch_size": 16}
    config = Qwen3VLConfig(text_config=text, vision_config=vision, tie_word_embeddings=tied)
    return build_qwen3_vl(config, torch.float32)
