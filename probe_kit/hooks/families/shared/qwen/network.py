"""Parts of Qwen's vision-language models that families share: construction, batches of prompts, images.

The networks themselves are transformers' own Qwen classes. Capture and actions are in `probe_kit.hooks`.

B batch, P positions, N patches of all pictures together, I pictures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from transformers import (
    Qwen2_5_VLConfig,
    Qwen2_5_VLForConditionalGeneration,
    Qwen3VLConfig,
    Qwen3VLForConditionalGeneration,
)
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil, smart_resize
from transformers.models.qwen2_vl.image_processing_qwen2_vl import Qwen2VLImageProcessor

from probe_kit.errors import CheckpointError, ObservationError
from probe_kit.models.building import build_empty, fill_rotary
from probe_kit.models.checkpoint_files import PictureValues, Renames, processor_settings

QWEN2_5_NAMES: Renames = (
    (r"^visual\.", "model.visual."),
    (r"^model\.(?!language_model\.|visual\.)", "model.language_model."),
)
"""Renames of Qwen2.5-VL, which was released under names that transformers has changed since."""

_QWEN2_5: dict[str, dict[str, Any]] = {
    "7B": {"hidden_size": 3584, "num_hidden_layers": 28, "num_attention_heads": 28, "num_key_value_heads": 4,
           "intermediate_size": 18944, "vocab_size": 152064},
    "32B": {"hidden_size": 5120, "num_hidden_layers": 64, "num_attention_heads": 40, "num_key_value_heads": 8,
            "intermediate_size": 27648, "vocab_size": 152064},
    "3B": {"hidden_size": 2048, "num_hidden_layers": 36, "num_attention_heads": 16, "num_key_value_heads": 2,
           "intermediate_size": 11008, "vocab_size": 151936},
}  # fmt: skip
_QWEN2_5_MLP = {"7B": 3420, "32B": 3456, "3B": 3420}
_TIED = frozenset({"3B", "4B"})
_QWEN3: dict[str, dict[str, Any]] = {
    "8B": {"hidden_size": 4096, "num_hidden_layers": 36, "num_attention_heads": 32, "intermediate_size": 12288},
    "32B": {"hidden_size": 5120, "num_hidden_layers": 64, "num_attention_heads": 64, "intermediate_size": 25600},
    "4B": {"hidden_size": 2560, "num_hidden_layers": 36, "num_attention_heads": 32, "intermediate_size": 9728},
}
_QWEN3_VISION: dict[str, Any] = {
    "depth": 27,
    "hidden_size": 1152,
    "intermediate_size": 4304,
    "num_heads": 16,
    "deepstack_visual_indexes": [8, 16, 24],
}
_QWEN3_SMALL_VISION: dict[str, Any] = {
    "depth": 24,
    "hidden_size": 1024,
    "intermediate_size": 4096,
    "num_heads": 16,
    "deepstack_visual_indexes": [5, 11, 17],
}


def build_qwen2_5_vl(config: Any, dtype: torch.dtype, device: str = "meta") -> Any:
    """Return the network in eval mode; see `build_empty`."""
    return _build(lambda: Qwen2_5_VLForConditionalGeneration(config), dtype, device)


def build_qwen3_vl(config: Any, dtype: torch.dtype, device: str = "meta") -> Any:
    """Return the network in eval mode; see `build_empty`."""
    return _build(lambda: Qwen3VLForConditionalGeneration(config), dtype, device)


def _build(make: Any, dtype: torch.dtype, device: str) -> Any:
    network = build_empty(make, dtype, device)
    fill_rotary(network)
    return network


def qwen2_5_vl_config(size: str) -> Qwen2_5_VLConfig:
    """Return the configuration of a released size."""
    text = {**_QWEN2_5[size], "rope_scaling": {"type": "mrope", "mrope_section": [16, 24, 24]}}
    vision = {
        "depth": 32,
        "hidden_size": 1280,
        "intermediate_size": _QWEN2_5_MLP[size],
        "num_heads": 16,
        "out_hidden_size": text["hidden_size"],
        "patch_size": 14,
        "window_size": 112,
        "fullatt_block_indexes": [7, 15, 23, 31],
    }
    tied = size in _TIED
    return Qwen2_5_VLConfig(text_config=text, vision_config=vision, tie_word_embeddings=tied)


def full_size_qwen2_5_vl(size: str) -> Any:
    """Return a released size on the meta device."""
    return build_qwen2_5_vl(qwen2_5_vl_config(size), torch.float32)


def qwen3_vl_config(size: str) -> Qwen3VLConfig:
    """Return the configuration of a released size."""
    text = {
        **_QWEN3[size],
        "num_key_value_heads": 8,
        "head_dim": 128,
        "vocab_size": 151936,
        "rope_parameters": {
            "rope_type": "default",
            "rope_theta": 5000000.0,
            "mrope_section": [24, 20, 20],
            "mrope_interleaved": True,
        },
    }
    tied = size in _TIED
    vision_sizes = _QWEN3_SMALL_VISION if tied else _QWEN3_VISION
    vision = {**vision_sizes, "out_hidden_size": text["hidden_size"], "patch_size": 16}
    return Qwen3VLConfig(text_config=text, vision_config=vision, tie_word_embeddings=tied)


def full_size_qwen3_vl(size: str) -> Any:
    """Return a released size on the meta device."""
    return build_qwen3_vl(qwen3_vl_config(size), torch.float32)


# -- batches of prompts ---------------------------------------------------------------------------------------

IMAGE = "<|vision_start|><|image_pad|><|vision_end|>"
"""The place of a picture in a prompt; `image_slots` repeats the middle token."""


@dataclass(frozen=True)
class QwenInputs:
    """A batch of prompts with their pictures.

    Attributes:
        ids: (B, P) int64 ids.
        mask: (B, P) int64, 0 at padding.
        pixel_values: (N, channels x time x patch x patch) float32 patches.
        grid: (I, 3) int64, per picture its patches over time, height and width.
        image_token: The id that stands for a picture's tokens.
    """

    ids: Tensor
    mask: Tensor
    pixel_values: Tensor
    grid: Tensor
    image_token: int

    def to(self, device: str) -> "QwenInputs":
        """Return the same on another device."""
        return replace(
            self,
            ids=self.ids.to(device),
            mask=self.mask.to(device),
            pixel_values=self.pixel_values.to(device),
            grid=self.grid.to(device),
        )

    def positions(self, model: Any) -> Tensor:
        """Return positions (3, B, P) over time, height and width, as the native class counts them.

        Padding counts 1, as in the transformers of these models' authors; nothing reads it.

        Args:
            model: Transformers' `Qwen…VLModel`.
        """
        counted, _ = model.get_rope_index(
            self.ids, mm_token_type_ids=self._kinds(), image_grid_thw=self.grid, attention_mask=self.mask
        )
        positions: Tensor = counted.masked_fill(self.mask[None] == 0, 1)
        return positions

    def keywords(self, model: Any) -> dict[str, Tensor]:
        """Return the keyword arguments of the native model's `forward`; never its cache of position offsets."""
        return {
            "input_ids": self.ids,
            "attention_mask": self.mask,
            "pixel_values": self.pixel_values,
            "image_grid_thw": self.grid,
            "mm_token_type_ids": self._kinds(),
            "position_ids": self.positions(model),
        }

    def _kinds(self) -> Tensor:
        """Return (B, P) int64: 1 at positions of pictures, 0 at text."""
        return (self.ids == self.image_token).long()


def image_slots(ids: Sequence[int], image_token: int, counts: Sequence[int]) -> list[int]:
    """Return the ids of a prompt in which the k-th image token is repeated `counts[k]` times.

    Args:
        ids: Ids of a prompt with one image token per picture.
        image_token: The id that stands for a picture's tokens.
        counts: Number of tokens of every picture.

    Raises:
        CheckpointError: If the numbers of image tokens and pictures differ: the tokenizer then does not know the
            token, or is another model's.
    """
    slots = [position for position, number in enumerate(ids) if number == image_token]
    if len(slots) != len(counts):
        raise CheckpointError(
            f"the tokenizer gave {len(slots)} image tokens (id {image_token}) for {len(counts)} pictures; "
            "tokenizer.json does not belong to this checkpoint"
        )
    filled: list[int] = []
    start = 0
    for slot, count in zip(slots, counts, strict=True):
        filled += [*ids[start:slot], *([image_token] * count)]
        start = slot + 1
    return [*filled, *ids[start:]]


def pack_inputs(
    rows: Sequence[Sequence[int]], pixel_values: Tensor, grid: Tensor, image_token: int, padding: int
) -> QwenInputs:
    """Return prompts of ids as one batch; padding stands behind each row.

    Args:
        rows: Ids of every prompt, with its image slots.
        pixel_values: (N, channels x time x patch x patch) patches of all pictures, in the order of the rows.
        grid: (I, 3) grids of all pictures, in the order of the rows.
        image_token: The id that stands for a picture's tokens.
        padding: An id that pads; it is masked.
    """
    longest = max(map(len, rows))
    ids = torch.full((len(rows), longest), padding)
    mask = torch.zeros((len(rows), longest), dtype=torch.long)
    for index, row in enumerate(rows):
        ids[index, : len(row)] = torch.tensor(row)
        mask[index, : len(row)] = 1
    return QwenInputs(ids, mask, pixel_values, grid, image_token)


# -- pictures -------------------------------------------------------------------------------------------------

_NEEDED = ("patch_size", "temporal_patch_size", "merge_size", "image_mean", "image_std")
_OPTIONAL = ("do_resize", "do_rescale", "rescale_factor", "do_normalize", "resample", "do_convert_rgb")
_LONGEST_RATIO = 200


@dataclass(frozen=True)
class QwenPictures:
    """The processor of pictures into patches.

    Attributes:
        settings: The part of the checkpoint's file that transformers' Qwen image processor reads, with the
            smallest and the largest number of pixels as `size`.
        patch: Pixels per patch side.
        merge: Patches per token side.
        fast: Whether the model's authors ran the processor on torchvision; else they ran the one on PIL and numpy.
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
        """Read the settings of pictures; see `picture_values`.

        Args:
            folder: Folder of the checkpoint.
            patch: Pixels per patch side with which the network was built.
            temporal: Frames per patch with which the network was built.
            merge: Patches per token side with which the network was built.
            fast: As in `QwenPictures`.

        Raises:
            CheckpointError: If the file is missing, lacks a number, or was made for another network.
        """
        stored = processor_settings(folder, _NEEDED, (*_OPTIONAL, "size", "min_pixels", "max_pixels"))
        values = stored.values
        stored_sizes = tuple(int(values[name]) for name in _NEEDED[:3])
        if stored_sizes != (patch, temporal, merge):
            raise CheckpointError(
                f"{stored.source} cuts pictures with patch_size, temporal_patch_size, merge_size {stored_sizes}; "
                f"config.json expects {(patch, temporal, merge)}"
            )
        settings = {name: values[name] for name in (*_NEEDED, *_OPTIONAL) if name in values}
        return cls({**settings, "size": _size(stored)}, patch, merge, fast)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Return the rows and columns of patches of a picture of that size."""
        if not self.settings.get("do_resize", True):
            return height // self.patch, width // self.patch
        low, high = (self.settings["size"][edge] for edge in ("shortest_edge", "longest_edge"))
        tall, wide = smart_resize(height, width, self.patch * self.merge, low, high)
        return tall // self.patch, wide // self.patch

    def patches(self, pictures: list[NDArray[np.uint8]]) -> tuple[Tensor, Tensor]:
        """Return the patches (N, channels x time x patch x patch) float32 and the grid (I, 3) int64 of pictures.

        The pictures are (H, W, 3) uint8.

        Raises:
            ObservationError: For a picture whose longer side is more than two hundred times the shorter one.
        """
        for picture in pictures:
            if max(picture.shape[:2]) > _LONGEST_RATIO * min(picture.shape[:2]):
                raise ObservationError(f"the picture is {picture.shape}: too long for this model's patches")
        kind: Any = Qwen2VLImageProcessor if self.fast else Qwen2VLImageProcessorPil
        processed = kind(**self.settings)(images=pictures, input_data_format="channels_last", return_tensors="pt")
        return processed["pixel_values"].float(), processed["image_grid_thw"]


def merged_tokens(grid: tuple[int, int], merge: int) -> int:
    """Return the number of prompt positions of a picture of that many rows and columns of patches."""
    return grid[0] * grid[1] // merge**2


def _size(settings: PictureValues) -> dict[str, int]:
    """Return the smallest and largest number of pixels; the older files name them apart."""
    values = settings.values
    size = values.get("size") or {}
    low = values.get("min_pixels") or size.get("shortest_edge") or size.get("min_pixels")
    high = values.get("max_pixels") or size.get("longest_edge") or size.get("max_pixels")
    if not low or not high:
        raise CheckpointError(
            f"{settings.source} has neither size.shortest_edge and longest_edge nor min_pixels, max_pixels"
        )
    return {"shortest_edge": int(low), "longest_edge": int(high)}
