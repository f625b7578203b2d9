"""The adapter for Qwen2.5-VL: chat with a system turn; positions along time, height and width."""

from typing import ClassVar

from transformers import Qwen2_5_VLConfig

from probe_kit.hooks.families.shared.qwen.vlm import SYSTEM, QwenVLM, qwen_frame
from probe_kit.hooks.families.shared.vlm.loading import Recipe
from probe_kit.hooks.families.shared.vlm.text import Frame
from probe_kit.models.qwen import QWEN2_5_NAMES, build_qwen2_5_vl


class Qwen25VL(QwenVLM):
    """A loaded Qwen2.5-VL."""

    family: ClassVar[str] = "qwen2.5-vl"
    frame: ClassVar[Frame] = qwen_frame(SYSTEM)
    recipe: ClassVar[Recipe] = Recipe(Qwen2_5_VLConfig.from_dict, build_qwen2_5_vl, QWEN2_5_NAMES)
