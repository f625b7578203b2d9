"""Prismatic vision-language models and OpenVLA, in plain torch, timm and transformers.

Names of modules and parameters are those of the released files, so that a checkpoint loads as it is.
Capture and actions are in the adapters `prismatic` and `openvla` in `probe_kit.hooks.families`.
"""

from probe_kit.models.prismatic.config import PrismaticConfig, TowerConfig
from probe_kit.models.prismatic.network import (
    PrismaticNetwork,
    build_prismatic,
    full_size_openvla,
    full_size_prismatic,
)
from probe_kit.models.prismatic.pictures import CROP_AREA, PictureSettings, centre_crop, prepare_picture

__all__ = [
    "CROP_AREA",
    "PictureSettings",
    "PrismaticConfig",
    "PrismaticNetwork",
    "TowerConfig",
    "build_prismatic",
    "centre_crop",
    "full_size_openvla",
    "full_size_prismatic",
    "prepare_picture",
]
