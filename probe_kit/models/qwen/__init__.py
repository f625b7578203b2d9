"""Code that families on Qwen's vision-language models share: images, batches of prompts, construction.

The networks themselves are transformers' own Qwen classes. Capture and actions are in `probe_kit.hooks`.
"""

from probe_kit.models.building import build_empty, fill_rotary, without_precision
from probe_kit.models.qwen.inputs import IMAGE, QwenInputs, image_slots, pack_inputs
from probe_kit.models.qwen.networks import (
    QWEN2_5_NAMES,
    build_qwen2_5_vl,
    build_qwen3_vl,
    full_size_qwen2_5_vl,
    full_size_qwen3_vl,
    qwen2_5_vl_config,
)
from probe_kit.models.qwen.pictures import QwenPictures, merged_tokens

__all__ = [
    "IMAGE",
    "QWEN2_5_NAMES",
    "QwenInputs",
    "QwenPictures",
    "build_empty",
    "build_qwen2_5_vl",
    "build_qwen3_vl",
    "fill_rotary",
    "full_size_qwen2_5_vl",
    "full_size_qwen3_vl",
    "image_slots",
    "merged_tokens",
    "pack_inputs",
    "qwen2_5_vl_config",
    "without_precision",
]
