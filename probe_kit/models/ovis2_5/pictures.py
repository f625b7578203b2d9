"""Images to patches, as in Ovis2.5's own code."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from transformers.models.qwen2_vl.image_processing_qwen2_vl import smart_resize

from probe_kit.errors import ObservationError
from probe_kit.models.ovis2_5.config import VisionConfig
from probe_kit.models.processor_file import processor_settings

SMALLEST, LARGEST = 448 * 448, 1792 * 1792
"""Pixels between which pictures are brought; the authors' code has them, no file does."""
_LONGEST_RATIO = 200
_NEEDED = ("image_mean", "image_std", "resample", "rescale_factor")


@dataclass(frozen=True)
class OvisPictures:
    """The processor of pictures into patches. patch, stride: see `VisionConfig`."""

    settings: dict[str, Any]
    patch: int
    stride: int

    @classmethod
    def from_folder(cls, folder: Path, vision: VisionConfig) -> "OvisPictures":
        """Read `preprocessor_config.json`. Raises CheckpointError."""
        return cls(processor_settings(folder, _NEEDED), vision.patch, vision.stride)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of patches of a picture of that size. Raises ObservationError if too long."""
        if max(height, width) > _LONGEST_RATIO * min(height, width):
            raise ObservationError(f"the picture is {height} x {width}: too long for this model's patches")
        tall, wide = smart_resize(height, width, self.patch * self.stride, SMALLEST, LARGEST)
        return tall // self.patch, wide // self.patch

    def tokens(self, height: int, width: int) -> int:
        """Visual words of a picture of that size."""
        rows, columns = self.grid(height, width)
        return rows * columns // self.stride**2

    def patches(self, pictures: list[NDArray[np.uint8]]) -> tuple[Tensor, Tensor]:
        """(N, 3 x patch x patch) float32 and grid (B, 3) int64 of (H, W, 3) uint8 pictures.

        The patches of one visual word follow each other.
        """
        grids = [self.grid(*picture.shape[:2]) for picture in pictures]
        rows = [self._cut(picture, grid) for picture, grid in zip(pictures, grids, strict=True)]
        return torch.from_numpy(np.concatenate(rows)), torch.tensor([(1, *grid) for grid in grids])

    def _cut(self, picture: NDArray[np.uint8], grid: tuple[int, int]) -> NDArray[np.float32]:
        tall, wide = grid[0] * self.patch, grid[1] * self.patch
        resampling = Image.Resampling(int(self.settings["resample"]))
        pixels = np.asarray(Image.fromarray(picture).resize((wide, tall), resampling), np.float64)
        mean, deviation = (np.asarray(self.settings[name], np.float32) for name in ("image_mean", "image_std"))
        scaled = (pixels * float(self.settings["rescale_factor"])).astype(np.float32)
        normalised = (scaled - mean) / deviation
        side = self.stride
        cut = normalised.reshape(
            grid[0] // side, side, self.patch, grid[1] // side, side, self.patch, 3
        )  # word row, row in word, y, word column, column in word, x, channel
        ordered = cut.transpose(0, 3, 1, 4, 6, 2, 5)
        return np.ascontiguousarray(ordered, np.float32).reshape(grid[0] * grid[1], -1)
