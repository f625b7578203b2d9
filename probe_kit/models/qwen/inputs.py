"""Inputs of a Qwen vision-language model: ids with slots for pictures, mask, image patches.

B batch, P positions, N patches of all pictures together, I pictures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from probe_kit.errors import CheckpointError

IMAGE = "<|vision_start|><|image_pad|><|vision_end|>"
"""Where a picture goes in a prompt; `image_slots` repeats the middle token."""


@dataclass(frozen=True)
class QwenInputs:
    """A batch of prompts with their pictures.

    ids: (B, P) int64. mask: (B, P) int64, 0 at padding. pixel_values: (N, channels x time x patch x patch)
    float32. grid: (I, 3) int64, per picture its patches over time, height and width.
    image_token: the id that stands for a picture's tokens.
    """

    ids: Tensor
    mask: Tensor
    pixel_values: Tensor
    grid: Tensor
    image_token: int

    def to(self, device: str) -> "QwenInputs":
        """The same on another device."""
        return replace(
            self,
            ids=self.ids.to(device),
            mask=self.mask.to(device),
            pixel_values=self.pixel_values.to(device),
            grid=self.grid.to(device),
        )

    def positions(self, model: Any) -> Tensor:
        """(3, B, P) positions over time, height and width, as the native class counts them.

        model: transformers' `Qwen…VLModel`. Padding counts 1, as in the transformers of these models' authors;
        nothing reads it.
        """
        counted, _ = model.get_rope_index(
            self.ids, mm_token_type_ids=self._kinds(), image_grid_thw=self.grid, attention_mask=self.mask
        )
        positions: Tensor = counted.masked_fill(self.mask[None] == 0, 1)
        return positions

    def keywords(self, model: Any) -> dict[str, Tensor]:
        """Keyword arguments of the native model's `forward`; never its cache of position offsets."""
        return {
            "input_ids": self.ids,
            "attention_mask": self.mask,
            "pixel_values": self.pixel_values,
            "image_grid_thw": self.grid,
            "mm_token_type_ids": self._kinds(),
            "position_ids": self.positions(model),
        }

    def _kinds(self) -> Tensor:
        """(B, P) int64: 1 at positions of pictures, 0 at text."""
        return (self.ids == self.image_token).long()


def image_slots(ids: Sequence[int], image_token: int, counts: Sequence[int]) -> list[int]:
    """Ids of a prompt in which the k-th image token is repeated `counts[k]` times.

    ids: of a prompt with one image token per picture. Raises CheckpointError where their number differs: the
    tokenizer then does not know the token, or is another model's.
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
    """Prompts of ids as one batch; padding stands behind each row.

    pixel_values, grid: of all pictures, in the order of the rows. padding: an id that pads; it is masked.
    """
    longest = max(map(len, rows))
    ids = torch.full((len(rows), longest), padding)
    mask = torch.zeros((len(rows), longest), dtype=torch.long)
    for index, row in enumerate(rows):
        ids[index, : len(row)] = torch.tensor(row)
        mask[index, : len(row)] = 1
    return QwenInputs(ids, mask, pixel_values, grid, image_token)
