"""Images to patches, as in the processors of Qwen's models; the size depends on the image's own."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil, smart_resize
from transformers.models.qwen2_vl.image_processing_qwen2_vl import Qwen2VLImageProcessor

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError, ObservationError

SETTINGS_FILE = "preprocessor_config.json"
_NEEDED = ("patch_size", "temporal_patch_size", "merge_size", "image_mean", "image_std")
_OPTIONAL = ("do_resize", "do_rescale", "rescale_factor", "do_normalize", "resample", "do_convert_rgb")
_LONGEST_RATIO = 200


@dataclass(frozen=True)
class QwenPictures:
    """The processor of pictures into patches.

    settings: the part of the checkpoint's file that transformers' Qwen image processor reads, with the smallest
    and the largest number of pixels as `size`. patch, merge: pixels per patch side, patches per token side.
    fast: which of the two processors the model's authors ran: the one on torchvision, or the one on PIL and numpy.
    They differ in a picture's last bits, and by a few grey levels where they resize.
    """

    settings: dict[str, Any]
    patch: int
    merge: int
    fast: bool = False

    @classmethod
    def from_folder(
        cls, folder: Path, patch: int, temporal: int, merge: int, fast: bool = False
    ) -> "QwenPictures":
        """Read `preprocessor_config.json`.

        patch, temporal, merge: what the network was built with. Raises CheckpointError if the file is missing,
        lacks a number, or was made for another network.
        """
        file = folder / SETTINGS_FILE
        if not file.is_file():
            raise CheckpointError(
                f"{file} is missing; it defines the size of this checkpoint's pictures. "
                "It comes with the checkpoint, or with the vision-language model it was made of"
            )
        values = load_json(file)
        if missing := [name for name in _NEEDED if name not in values]:
            raise CheckpointError(f"{file} lacks {', '.join(missing)}")
        stored_sizes = tuple(int(values[name]) for name in _NEEDED[:3])
        if stored_sizes != (patch, temporal, merge):
            raise CheckpointError(
                f"{file} cuts pictures with patch_size, temporal_patch_size, merge_size {stored_sizes}; "
                f"config.json expects {(patch, temporal, merge)}"
            )
        settings = {name: values[name] for name in (*_NEEDED, *_OPTIONAL) if name in values}
        return cls({**settings, "size": _size(values, file)}, patch, merge, fast)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of patches of a picture of that size."""
        if not self.settings.get("do_resize", True):
            return height // self.patch, width // self.patch
        low, high = (self.settings["size"][edge] for edge in ("shortest_edge", "longest_edge"))
        tall, wide = smart_resize(height, width, self.patch * self.merge, low, high)
        return tall // self.patch, wide // self.patch

    def patches(self, pictures: list[NDArray[np.uint8]]) -> tuple[Tensor, Tensor]:
        """(N, channels x time x patch x patch) float32 and grid (I, 3) int64 of (H, W, 3) uint8 pictures.

        Raises ObservationError for a picture two hundred times as long as wide.
        """
        for picture in pictures:
            if max(picture.shape[:2]) > _LONGEST_RATIO * min(picture.shape[:2]):
                raise ObservationError(f"the picture is {picture.shape}: too long for this model's patches")
        kind: Any = Qwen2VLImageProcessor if self.fast else Qwen2VLImageProcessorPil
        processed = kind(**self.settings)(images=pictures, input_data_format="channels_last", return_tensors="pt")
        return processed["pixel_values"].float(), processed["image_grid_thw"]


def merged_tokens(grid: tuple[int, int], merge: int) -> int:
    """Positions a picture of that many rows and columns of patches takes in the prompt."""
    return grid[0] * grid[1] // merge**2


def _size(values: dict[str, Any], file: Path) -> dict[str, int]:
    """Smallest and largest number of pixels; the older files name them apart."""
    size = values.get("size") or {}
    low = values.get("min_pixels") or size.get("shortest_edge") or size.get("min_pixels")
    high = values.get("max_pixels") or size.get("longest_edge") or size.get("max_pixels")
    if not low or not high:
        raise CheckpointError(f"{file} has neither size.shortest_edge and longest_edge nor min_pixels, max_pixels")
    return {"shortest_edge": int(low), "longest_edge": int(high)}
