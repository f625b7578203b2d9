"""What the families built on Qwen's vision-language models share: pictures, prompts as batches, construction.

The networks themselves are transformers' own Qwen classes. Nothing here listens or acts.
"""

from probe_kit.models.building import build_empty, fill_rotary, without_precision
from probe_kit.models.qwen.chat import IMAGE, image_slots
from probe_kit.models.qwen.inputs import QwenInputs, pack_inputs
from probe_kit.models.qwen.pictures import QwenPictures, merged_tokens

__all__ = [
    "IMAGE",
    "QwenInputs",
    "QwenPictures",
    "build_empty",
    "fill_rotary",
    "image_slots",
    "merged_tokens",
    "pack_inputs",
    "without_precision",
]
