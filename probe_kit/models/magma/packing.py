"""Prompts with pictures as one batch.

A picture takes the place of the one placeholder in its prompt. Padding stands before the last token of a row: the
last tokens line up, and no other token moves, whatever else is in the batch. Positions count tokens only, so the
network computes the same numbers as without padding.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from probe_kit.errors import CheckpointError


@dataclass(frozen=True)
class PictureSpan:
    """The positions of a picture's tokens in its row: `start`, then `rows` times `columns` and a separator."""

    start: int
    rows: int
    columns: int

    @property
    def length(self) -> int:
        """Tokens, separators included."""
        return self.rows * (self.columns + 1)


@dataclass(frozen=True)
class Packed:
    """A batch: embeddings (B, S, D), zero at padding, and mask (B, S) bool, False at padding."""

    embeddings: Tensor
    mask: Tensor

    @classmethod
    def of(cls, rows: Sequence[Tensor]) -> "Packed":
        """Pack one (T, D) row per prompt."""
        longest = max(row.shape[0] for row in rows)
        embeddings = rows[0].new_zeros(len(rows), longest, rows[0].shape[1])
        mask = torch.zeros(len(rows), longest, dtype=torch.bool, device=rows[0].device)
        for index, row in enumerate(rows):
            length = row.shape[0] - 1
            embeddings[index, :length], embeddings[index, -1] = row[:-1], row[-1]
            mask[index, :length], mask[index, -1] = True, True
        return cls(embeddings, mask)


def placeholder(ids: Sequence[int], image_token: int) -> int:
    """The position of the placeholder. Raises CheckpointError unless there is exactly one."""
    places = [position for position, number in enumerate(ids) if number == image_token]
    if len(places) != 1:
        raise CheckpointError(
            f"the prompt has {len(places)} picture placeholders (id {image_token}); expected one. The tokenizer "
            "does not know <image> as one token, or the text itself contains it"
        )
    return places[0]


def positions(mask: Tensor) -> Tensor:
    """(B, S) positions that count tokens, not padding."""
    return (mask.long().cumsum(dim=1) - 1).clamp(min=0)


def needed(mask: Tensor) -> Tensor | None:
    """The mask where there is padding: without one, attention takes its exact causal path."""
    return None if bool(mask.all()) else mask
