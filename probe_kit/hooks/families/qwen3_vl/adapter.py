"""The adapter for Qwen3-VL: chat without a system turn; DeepStack adds pictures between its first blocks."""

from typing import ClassVar

from transformers import Qwen3VLConfig

from probe_kit.hooks.families.shared.qwen.vlm import QwenVLM, qwen_frame
from probe_kit.hooks.families.shared.vlm.loading import Recipe
from probe_kit.hooks.families.shared.vlm.text import Frame
from probe_kit.models.qwen import build_qwen3_vl


class Qwen3VL(QwenVLM):
    """A loaded Qwen3-VL."""

    family: ClassVar[str] = "qwen3-vl"
    frame: ClassVar[Frame] = qwen_frame()
    recipe: ClassVar[Recipe] = Recipe(Qwen3VLConfig.from_dict, build_qwen3_vl)
    sums: ClassVar[bool] = False
