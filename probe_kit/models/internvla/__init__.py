"""InternVLA-M1: Qwen2.5-VL and DINOv2, a querying transformer, a guided diffusion head, in torch and transformers.

Names of modules and parameters are those of the released files, so that a checkpoint loads as it is.
Capture and actions are in its adapter in `probe_kit.hooks`.
"""

from probe_kit.models.internvla.config import InternVLAConfig, find_config
from probe_kit.models.internvla.diffusion import Schedule, guided
from probe_kit.models.internvla.network import InternVLANetwork, build_internvla, full_size_internvla
from probe_kit.models.internvla.scene import dino_pixels, look, prompt

__all__ = [
    "InternVLAConfig",
    "InternVLANetwork",
    "Schedule",
    "build_internvla",
    "dino_pixels",
    "find_config",
    "full_size_internvla",
    "guided",
    "look",
    "prompt",
]
