"""InternVL3 on transformers' own network: configuration, construction, pictures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from transformers import InternVLConfig, InternVLForConditionalGeneration
from transformers.models.got_ocr2.image_processing_got_ocr2 import GotOcr2ImageProcessor

from probe_kit.errors import CheckpointError
from probe_kit.models.building import build_empty, fill_decoder_rotary
from probe_kit.models.checkpoint_files import LANGUAGE_FIRST, processor_settings, square_side

FILE_NAMES = LANGUAGE_FIRST

_TEXT: dict[str, dict[str, Any]] = {
    "8B": {"hidden_size": 4096, "num_hidden_layers": 36, "num_attention_heads": 32, "intermediate_size": 12288},
    "38B": {"hidden_size": 5120, "num_hidden_layers": 64, "num_attention_heads": 64, "intermediate_size": 25600},
}
_VISION: dict[str, dict[str, Any]] = {
    "8B": {"hidden_size": 1024, "num_hidden_layers": 24, "num_attention_heads": 16, "intermediate_size": 4096,
           "norm_type": "layer_norm", "attention_bias": True, "use_qk_norm": False},
    "38B": {"hidden_size": 3200, "num_hidden_layers": 45, "num_attention_heads": 25, "intermediate_size": 12800,
            "norm_type": "rms_norm", "attention_bias": False, "use_qk_norm": True},
}  # fmt: skip


def build_internvl(config: Any, dtype: torch.dtype, device: str = "meta") -> Any:
    """Return the network in eval mode, see `build_empty`, with the rotary frequencies that no checkpoint holds."""
    network: Any = build_empty(lambda: InternVLForConditionalGeneration(config), dtype, device)
    fill_decoder_rotary(network.model.language_model)
    network.tie_weights()
    return network


def full_size_internvl(size: str) -> Any:
    """Return a released size on the meta device."""
    text = {**_TEXT[size], "model_type": "qwen3", "num_key_value_heads": 8, "head_dim": 128, "vocab_size": 151936}
    vision = {
        **_VISION[size],
        "model_type": "internvl_vision",
        "image_size": [448, 448],
        "patch_size": [14, 14],
        "use_mean_pooling": True,
    }
    config = InternVLConfig(text_config=text, vision_config=vision, tie_word_embeddings=False)
    return build_internvl(config, torch.float32)


# -- pictures -------------------------------------------------------------------------------------------------

_NEEDED = ("image_mean", "image_std", "size")
_OPTIONAL = ("do_resize", "do_rescale", "rescale_factor", "do_normalize", "resample", "min_patches", "max_patches")


@dataclass(frozen=True)
class TiledPictures:
    """The processor of pictures into tiles.

    Attributes:
        settings: The part of the checkpoint's file that the processor reads.
        tiled: Whether to cut pictures into a grid, as the released processor does whatever its file says; False
            shows the whole picture as one tile.
    """

    settings: dict[str, Any]
    tiled: bool = True

    @classmethod
    def from_folder(cls, folder: Path, side: int, tiled: bool = True) -> "TiledPictures":
        """Read the settings of pictures; see `picture_values`.

        Args:
            folder: Folder of the checkpoint.
            side: Side in pixels of the tiles that the network expects.
            tiled: As in `TiledPictures`.

        Raises:
            CheckpointError: If the file is missing, lacks a value, or makes tiles of another side.
        """
        stored = processor_settings(folder, _NEEDED, _OPTIONAL)
        if (stored_side := square_side(stored)) != side:
            raise CheckpointError(
                f"{stored.source} makes tiles of {stored_side} pixels; config.json expects {side}"
            )
        return cls(stored.values, tiled)

    @property
    def _processor(self) -> Any:
        return GotOcr2ImageProcessor(**self.settings, crop_to_patches=self.tiled)

    def tiles(self, height: int, width: int) -> int:
        """Return the number of tiles of a picture of that size.

        The whole picture is included where there are several. The nearest shape of a grid depends on the last bit:
        560 x 480 makes 4 x 3 tiles and not one, by 2e-16.
        """
        return int(self._processor.get_number_of_image_patches(height, width))

    def pixels(self, pictures: list[NDArray[np.uint8]]) -> Tensor:
        """Return the tiles of all (H, W, 3) uint8 pictures, (tiles, 3, S, S) float32."""
        processed = self._processor(images=pictures, input_data_format="channels_last", return_tensors="pt")
        pixels: Tensor = processed["pixel_values"]
        return pixels
