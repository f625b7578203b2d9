"""Images to crops, bit-identical to the original processor.

Colours are normalised first; then the picture is stretched, aspect not kept, to the grid of square crops that
shows most of its pixels, without antialiasing.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError
from probe_kit.models.magma.config import VisionConfig

Colour = tuple[float, float, float]
# CLIP's (Radford et al. 2021), the defaults of Magma's image processor.
_MEAN: Colour = (0.48145466, 0.4578275, 0.40821073)
_DEVIATION: Colour = (0.26862954, 0.26130258, 0.27577711)


@dataclass(frozen=True)
class Grid:
    """The crops of a picture: rows from top to bottom, columns from left to right."""

    rows: int
    columns: int


@dataclass(frozen=True)
class Picture:
    """One prepared picture: crops (rows · columns, 3, S, S) float32 in raster order."""

    crops: Tensor
    grid: Grid


@dataclass(frozen=True)
class PictureSettings:
    """The preparation of pictures. base: side S of a crop in pixels; crops: the most crops of one picture."""

    base: int
    crops: int
    mean: Colour = _MEAN
    deviation: Colour = _DEVIATION

    @classmethod
    def of(cls, vision: VisionConfig, folder: Path) -> "PictureSettings":
        """Read `folder/preprocessor_config.json`, or where there is none the configuration.

        Recorded references hold the same fields in `action_config.json`.
        Raises CheckpointError for a file that lacks a field.
        """
        for name, part in (("preprocessor_config.json", None), ("action_config.json", "preprocessor")):
            if (folder / name).is_file():
                values = load_json(folder / name)
                return cls.from_json(values if part is None else values.get(part, {}), str(folder / name))
        return cls(vision.base, vision.crops)

    @classmethod
    def from_json(cls, values: dict[str, object], source: str) -> "PictureSettings":
        """Read the content of a `preprocessor_config.json`. Raises CheckpointError naming `source`."""
        missing = [name for name in ("base_img_size", "num_crops") if name not in values]
        if missing:
            raise CheckpointError(f"{source} lacks {' and '.join(missing)}; it does not belong to Magma")
        return cls(
            int(str(values["base_img_size"])),
            int(str(values["num_crops"])),
            _colour(values.get("image_mean", _MEAN), source),
            _colour(values.get("image_std", _DEVIATION), source),
        )


def _colour(values: object, source: str) -> Colour:
    if not isinstance(values, list | tuple) or len(values) != 3:
        raise CheckpointError(f"{source}: {values!r} is not one number per colour")
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def choose_grid(width: int, height: int, settings: PictureSettings) -> Grid:
    """The grid that keeps most of the picture's pixels and, among equals, wastes fewest; narrow ones first."""
    grids = [
        Grid(rows, columns)
        for columns in range(1, settings.crops + 1)
        for rows in range(1, settings.crops // columns + 1)
    ]

    def merit(grid: Grid) -> tuple[int, int]:
        wide, high = grid.columns * settings.base, grid.rows * settings.base
        scale = min(wide / width, high / height)
        pixels = min(int(width * scale) * int(height * scale), width * height)
        return pixels, pixels - wide * high

    return max(grids, key=merit)


def shrink_picture(picture: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """(side, side, 3) uint8 from (H, W, 3) uint8, bicubic: what the evaluation client does first."""
    return np.asarray(Image.fromarray(picture).resize((side, side), Image.Resampling.BICUBIC))


def prepare_picture(picture: NDArray[np.uint8], settings: PictureSettings) -> Picture:
    """Crops of a (H, W, 3) uint8 picture."""
    height, width = picture.shape[:2]
    grid, side = choose_grid(width, height, settings), settings.base
    pixels = torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1))).float().div(255)
    mean, deviation = (torch.tensor(colour)[:, None, None] for colour in (settings.mean, settings.deviation))
    stretched = torch.nn.functional.interpolate(
        pixels.sub(mean).div(deviation)[None],
        size=(grid.rows * side, grid.columns * side),
        mode="bilinear",
        align_corners=False,
    )
    crops = stretched.reshape(3, grid.rows, side, grid.columns, side).permute(1, 3, 0, 2, 4)
    return Picture(crops.reshape(-1, 3, side, side).contiguous(), grid)
