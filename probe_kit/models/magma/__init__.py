"""Magma, in plain torch, timm and transformers.

Names of modules and parameters are those of the released files, so that a checkpoint loads as it is.
Capture and actions are in its adapter in `probe_kit.hooks`.
"""

from probe_kit.models.magma.config import MagmaConfig, VisionConfig, shipped_statistics
from probe_kit.models.magma.network import (
    UNUSED_WEIGHTS,
    MagmaNetwork,
    build_magma,
    full_size_magma,
)
from probe_kit.models.magma.packing import PictureSpan
from probe_kit.models.magma.pictures import (
    Grid,
    Picture,
    PictureSettings,
    choose_grid,
    prepare_picture,
    shrink_picture,
)
from probe_kit.models.magma.prompt import ACTION_QUESTION, Message, chat_text, conversation, picture_question

__all__ = [
    "ACTION_QUESTION",
    "UNUSED_WEIGHTS",
    "Grid",
    "MagmaConfig",
    "MagmaNetwork",
    "Message",
    "Picture",
    "PictureSettings",
    "PictureSpan",
    "VisionConfig",
    "build_magma",
    "chat_text",
    "choose_grid",
    "conversation",
    "full_size_magma",
    "picture_question",
    "prepare_picture",
    "shipped_statistics",
    "shrink_picture",
]
