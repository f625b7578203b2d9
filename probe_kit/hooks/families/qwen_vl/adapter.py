"""The adapters for Qwen2.5-VL and Qwen3-VL: chats with and without a system turn."""

from typing import ClassVar

from transformers import Qwen2_5_VLConfig, Qwen3VLConfig

from probe_kit.hooks.families.shared.loading import Recipe
from probe_kit.hooks.families.shared.qwen.adapter import SYSTEM, QwenVLM, qwen_frame
from probe_kit.hooks.families.shared.qwen.network import QWEN2_5_NAMES, build_qwen2_5_vl, build_qwen3_vl
from probe_kit.hooks.families.shared.text import QuestionFrame


class Qwen25VL(QwenVLM):
    """A loaded Qwen2.5-VL."""

    family: ClassVar[str] = "qwen2.5-vl"
    frame: ClassVar[QuestionFrame] = qwen_frame(SYSTEM)
    recipe: ClassVar[Recipe] = Recipe(Qwen2_5_VLConfig.from_dict, build_qwen2_5_vl, QWEN2_5_NAMES)


class Qwen3VL(QwenVLM):
    """A loaded Qwen3-VL."""

    family: ClassVar[str] = "qwen3-vl"
    frame: ClassVar[QuestionFrame] = qwen_frame()
    recipe: ClassVar[Recipe] = Recipe(Qwen3VLConfig.from_dict, build_qwen3_vl)
    sums: ClassVar[bool] = False
