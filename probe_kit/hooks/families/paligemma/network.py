"""The network PaliGemma as transformers implements it: construction and pictures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from transformers import PaliGemmaConfig, PaliGemmaForConditionalGeneration
from transformers.models.siglip.image_processing_siglip import SiglipImageProcessor

from probe_kit.errors import CheckpointError
from probe_kit.models.building import build_empty, fill_decoder_rotary
from probe_kit.models.checkpoint_files import (
    LANGUAGE_FIRST,
    SIGLIP_TOWER,
    PictureValues,
    processor_settings,
    square_side,
)

FILE_NAMES = (*LANGUAGE_FIRST, *SIGLIP_TOWER)


def build_paligemma(config: Any, dtype: torch.dtype, device: str = "meta") -> Any:
    """Return the network in eval mode; see `build_empty`.

    Buffers that no checkpoint holds are computed on the CPU.
    """
    network: Any = build_empty(lambda: PaliGemmaForConditionalGeneration(config), dtype, device)
    language = network.model.language_model
    fill_decoder_rotary(language)
    embedding = language.embed_tokens
    embedding.embed_scale = torch.tensor(embedding.scalar_embed_scale)
    embeddings = network.model.vision_tower.vision_model.embeddings
    embeddings.position_ids = torch.arange(embeddings.num_positions).expand((1, -1))
    network.tie_weights()
    return network


def full_size_paligemma() -> Any:
    """Return PaliGemma 3B for pictures of 224 pixels, on the meta device."""
    text = {
        "model_type": "gemma",
        "hidden_size": 2048,
        "intermediate_size": 16384,
        "num_hidden_layers": 18,
        "num_attention_heads": 8,
        "num_key_value_heads": 1,
        "head_dim": 256,
        "vocab_size": 257216,
    }
    vision = {
        "model_type": "siglip_vision_model",
        "hidden_size": 1152,
        "intermediate_size": 4304,
        "num_hidden_layers": 27,
        "num_attention_heads": 16,
        "patch_size": 14,
        "image_size": 224,
        "projection_dim": 2048,
        "vision_use_head": False,
    }
    config = PaliGemmaConfig(text_config=text, vision_config=vision, projection_dim=2048, hidden_size=2048)
    return build_paligemma(config, torch.float32)


# -- pictures -------------------------------------------------------------------------------------------------

CROP = "probe_kit_crop"
_NEEDED = ("image_mean", "image_std", "size")
_OPTIONAL = ("do_resize", "do_rescale", "rescale_factor", "do_normalize", "resample")


@dataclass(frozen=True)
class SquarePictures:
    """The processor of pictures into squares.

    Attributes:
        settings: The part of the checkpoint's file that the processor reads.
        crop: Part of the picture that is used, as shares of it: top, left, height, width; None for all of it. It
            is `CROP` in the file, which the processor skips.
    """

    settings: dict[str, Any]
    crop: tuple[float, float, float, float] | None = None

    @classmethod
    def from_folder(cls, folder: Path, side: int) -> "SquarePictures":
        """Read the settings of pictures; see `picture_values`.

        Args:
            folder: Folder of the checkpoint.
            side: Side in pixels of the pictures that the network expects.

        Raises:
            CheckpointError: If the file is missing, lacks a value, or makes pictures of another side.
        """
        stored = processor_settings(folder, _NEEDED, (*_OPTIONAL, CROP))
        if (stored_side := square_side(stored)) != side:
            raise CheckpointError(
                f"{stored.source} makes pictures of {stored_side} pixels; config.json expects {side}"
            )
        return cls({name: value for name, value in stored.values.items() if name != CROP}, _crop(stored))

    def pixels(self, pictures: list[NDArray[np.uint8]]) -> Tensor:
        """Return (H, W, 3) uint8 pictures as (B, 3, S, S) float32."""
        parts = [self._window(picture) for picture in pictures]
        processed = SiglipImageProcessor(**self.settings)(
            images=parts, input_data_format="channels_last", return_tensors="pt"
        )
        pixels: Tensor = processed["pixel_values"]
        return pixels

    def _window(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self.crop is None:
            return picture
        size = np.array(picture.shape[:2])
        top, column = np.rint(size * self.crop[:2]).astype(int)
        height, width = np.rint(size * self.crop[2:]).astype(int)
        return picture[top : top + max(1, height), column : column + max(1, width)]


def _crop(settings: PictureValues) -> tuple[float, float, float, float] | None:
    """Return the part of the picture that is used, None for all of it.

    Raises:
        CheckpointError: For numbers that are no part of a picture.
    """
    stored = settings.values.get(CROP)
    if stored is None:
        return None
    try:
        top, column, height, width = (float(share) for share in stored)
    except (TypeError, ValueError):
        top = column = height = width = float("nan")
    if not (0 <= top < top + height <= 1 and 0 <= column < column + width <= 1):
        raise CheckpointError(
            f"{settings.source} has {CROP} {stored}; expected top, left, height and width of the part "
            "that is looked at, as shares of the picture between 0 and 1"
        )
    return top, column, height, width
