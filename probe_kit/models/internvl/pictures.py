"""Images as tiles: a grid of the nearest aspect ratio, plus the whole image if there are several tiles."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from transformers.models.got_ocr2.image_processing_got_ocr2 import GotOcr2ImageProcessor

from probe_kit.errors import CheckpointError
from probe_kit.models.processor_file import processor_settings, square_side

_NEEDED = ("image_mean", "image_std", "size")
_OPTIONAL = ("do_resize", "do_rescale", "rescale_factor", "do_normalize", "resample", "min_patches", "max_patches")


@dataclass(frozen=True)
class TiledPictures:
    """The processor of pictures into tiles.

    settings: the part of the checkpoint's file that the processor reads. tiled: cut into a grid, as the released
    processor does whatever its file says; False shows the whole picture as one tile.
    """

    settings: dict[str, Any]
    tiled: bool = True

    @classmethod
    def from_folder(cls, folder: Path, side: int, tiled: bool = True) -> "TiledPictures":
        """Read `preprocessor_config.json`. side: pixels the network expects. Raises CheckpointError."""
        values = processor_settings(folder, _NEEDED, _OPTIONAL)
        if (stored_side := square_side(values, folder)) != side:
            raise CheckpointError(f"{folder} makes tiles of {stored_side} pixels; config.json expects {side}")
        return cls(values, tiled)

    @property
    def _processor(self) -> Any:
        return GotOcr2ImageProcessor(**self.settings, crop_to_patches=self.tiled)

    def tiles(self, height: int, width: int) -> int:
        """Tiles of a picture of that size, the whole picture included where there are several.

        The nearest shape of a grid hangs on the last bit: 560 x 480 makes 4 x 3 tiles and not one, by 2e-16.
        """
        return int(self._processor.get_number_of_image_patches(height, width))

    def pixels(self, pictures: list[NDArray[np.uint8]]) -> Tensor:
        """(tiles of all pictures, 3, S, S) float32 of (H, W, 3) uint8 pictures."""
        processed = self._processor(images=pictures, input_data_format="channels_last", return_tensors="pt")
        pixels: Tensor = processed["pixel_values"]
        return pixels
