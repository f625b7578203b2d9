"""Prompts of different lengths as one batch, for models that decode after their last token."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from probe_kit.models.decoding import positions


def packed(rows: Sequence[Tensor], padding: int = 0) -> tuple[Tensor, Tensor]:
    """Rows (T, …) as one batch (B, S, …), and its mask (B, S) bool, False at padding.

    Padding stands before the last token of a row: the last tokens line up, and no other token moves, whatever else
    is in the batch. Positions count tokens only, so the network computes the same numbers as without padding.
    """
    longest = max(map(len, rows))
    batch = rows[0].new_full((len(rows), longest, *rows[0].shape[1:]), padding)
    mask = torch.zeros((len(rows), longest), dtype=torch.bool, device=batch.device)
    for index, row in enumerate(rows):
        batch[index, : len(row) - 1], batch[index, -1] = row[:-1], row[-1]
        mask[index, : len(row) - 1], mask[index, -1] = True, True
    return batch, mask


@dataclass(frozen=True)
class Packed:
    """Prompts as one batch: ids (B, T) int64 and mask (B, T) bool, see `packed`."""

    ids: Tensor
    mask: Tensor

    @classmethod
    def of(cls, rows: Sequence[Sequence[int]], padding: int) -> "Packed":
        """Pack one prompt per row."""
        return cls(*packed([torch.tensor(row) for row in rows], padding))


@dataclass(frozen=True)
class LeftPacked:
    """Prompts as one batch: ids (B, T) int64 and mask (B, T) int64, 0 at padding, which stands before each row."""

    ids: Tensor
    mask: Tensor

    @classmethod
    def of(cls, rows: Sequence[Sequence[int]], padding: int, device: str = "cpu") -> "LeftPacked":
        """Pack one prompt per row."""
        longest = max(map(len, rows))
        ids = torch.full((len(rows), longest), padding)
        mask = torch.zeros((len(rows), longest), dtype=torch.long)
        for index, row in enumerate(rows):
            ids[index, longest - len(row) :] = torch.tensor(row)
            mask[index, longest - len(row) :] = 1
        return cls(ids.to(device), mask.to(device))

    def positions(self, first: int = 0) -> Tensor:
        """(B, T) positions that count tokens, not padding, from `first`."""
        return positions(self.mask) + first
