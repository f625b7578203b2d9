"""Xiaomi-Robotics-R0: Qwen3-VL and a flow transformer that reads its keys and values, in torch and transformers.

Names of modules and parameters are those of the released files, so that a checkpoint loads as it is.
Capture and actions are in its adapter in `probe_kit.hooks`.
"""

from probe_kit.models.xiaomi.config import XiaomiConfig
from probe_kit.models.xiaomi.network import Prompt, XiaomiNetwork, build_xiaomi, full_size_xiaomi
from probe_kit.models.xiaomi.robots import ActionUnits, Robot, read_units, robot_of
from probe_kit.models.xiaomi.scene import look, prompt

__all__ = [
    "ActionUnits",
    "Prompt",
    "Robot",
    "XiaomiConfig",
    "XiaomiNetwork",
    "build_xiaomi",
    "full_size_xiaomi",
    "look",
    "prompt",
    "read_units",
    "robot_of",
]
