"""Base adapter of Qwen's vision-language models: images as patches, positions, taps."""

from functools import cached_property
from typing import Any, ClassVar

from torch import Tensor

from probe_kit.hooks.contract.model import Tap
from probe_kit.hooks.families.shared.qwen.tower import by_picture, tower_tap
from probe_kit.hooks.families.shared.vlm.adapter import Pictures, VisionLanguageModel
from probe_kit.hooks.families.shared.vlm.text import Frame
from probe_kit.models.packing import LeftPacked
from probe_kit.models.qwen import QwenPictures, merged_tokens

SYSTEM = "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n"
USER, ASSISTANT = "<|im_start|>user\n", "<|im_end|>\n<|im_start|>assistant\n"


def qwen_frame(system: str = "") -> Frame:
    """Qwen's chat of one turn."""
    return Frame(f"{system}{USER}<|vision_start|>", "<|vision_end|>", f"{system}{USER}", ASSISTANT)


class QwenVLM(VisionLanguageModel):
    """A VLM on one of transformers' Qwen networks."""

    picture_token: ClassVar[str | None] = "<|image_pad|>"
    _grid: Tensor | None = None
    """Of the pictures under way: towers run over the patches of all rows at once."""

    @property
    def tower(self) -> Any:
        """The vision tower."""
        return self.network.model.visual

    @property
    def vision_size(self) -> tuple[int, int]:
        """Blocks and width of the vision tower."""
        return len(self.tower.blocks), int(self.network.config.vision_config.hidden_size)

    def vision_tap(self, layer: int) -> Tap:
        """The first norm of a block, or what reads the last one; patches in the tower's own order."""
        return tower_tap(self.tower, layer, self._by_picture)

    def _by_picture(self, patches: Tensor) -> Tensor:
        return by_picture(patches, self._grid)

    @cached_property
    def pictures(self) -> QwenPictures:
        """The processor of pictures into patches. Raises CheckpointError naming the missing file."""
        vision = self.network.config.vision_config
        sizes = (int(vision.patch_size), int(vision.temporal_patch_size), int(vision.spatial_merge_size))
        return QwenPictures.from_folder(self.loaded.folder, *sizes, fast=True)

    def picture_ids(self, height: int, width: int) -> list[int]:
        """Ids at a picture's positions, as many as its size demands."""
        count = merged_tokens(self.pictures.grid(height, width), self.pictures.merge)
        return [int(self.network.config.image_token_id)] * count

    def picture_inputs(self, pictures: Pictures) -> dict[str, Tensor]:
        """pixel_values (N, channels x time x patch x patch) and image_grid_thw (B, 3)."""
        pixels, self._grid = self.pictures.patches(pictures)
        device = self.loaded.device
        return {"pixel_values": pixels.to(device), "image_grid_thw": self._grid.to(device)}

    def positions(self, packed: LeftPacked, picture_inputs: dict[str, Tensor]) -> Tensor:
        """(3, B, T) over time, height and width, as the native class counts them; 0 at padding."""
        counted, _ = self.network.model.get_rope_index(
            packed.ids,
            image_grid_thw=picture_inputs.get("image_grid_thw"),
            attention_mask=packed.mask,
            **self.other_inputs(packed),
        )
        positions: Tensor = counted
        return positions

    def other_inputs(self, packed: LeftPacked) -> dict[str, Tensor]:
        """mm_token_type_ids: 1 at positions of pictures. Left out, Qwen2.5-VL silently counts them as text."""
        return {"mm_token_type_ids": (packed.ids == int(self.network.config.image_token_id)).long()}
