"""Pictures as one square, as SigLIP's processor makes them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from transformers.models.siglip.image_processing_siglip import SiglipImageProcessor

from probe_kit.errors import CheckpointError
from probe_kit.models.processor_file import processor_settings, square_side

_NEEDED = ("image_mean", "image_std", "size")
_OPTIONAL = ("do_resize", "do_rescale", "rescale_factor", "do_normalize", "resample")


@dataclass(frozen=True)
class SquarePictures:
    """How pictures become squares. settings: the part of the checkpoint's file that the processor reads."""

    settings: dict[str, Any]

    @classmethod
    def from_folder(cls, folder: Path, side: int) -> "SquarePictures":
        """Read `preprocessor_config.json`. side: pixels the network expects. Raises CheckpointError."""
        values = processor_settings(folder, _NEEDED, _OPTIONAL)
        if (found := square_side(values, folder)) != side:
            raise CheckpointError(f"{folder} makes pictures of {found} pixels; config.json expects {side}")
        return cls(values)

    def pixels(self, pictures: list[NDArray[np.uint8]]) -> Tensor:
        """(B, 3, S, S) float32 of (H, W, 3) uint8 pictures."""
        made = SiglipImageProcessor(**self.settings)(
            images=pictures, input_data_format="channels_last", return_tensors="pt"
        )
        pixels: Tensor = made["pixel_values"]
        return pixels
