"""Ovis2.5 in plain torch: vision tower, visual words, image processing. Contains no capture code."""

from probe_kit.models.ovis2_5.config import OvisConfig, VisionConfig
from probe_kit.models.ovis2_5.network import (
    PICTURE,
    PICTURE_BEGINS,
    PICTURE_ENDS,
    OvisNetwork,
    build_ovis2_5,
    full_size_ovis2_5,
)
from probe_kit.models.ovis2_5.pictures import OvisPictures

__all__ = [
    "PICTURE",
    "PICTURE_BEGINS",
    "PICTURE_ENDS",
    "OvisConfig",
    "OvisNetwork",
    "OvisPictures",
    "VisionConfig",
    "build_ovis2_5",
    "full_size_ovis2_5",
]
