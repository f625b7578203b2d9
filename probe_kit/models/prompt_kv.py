"""Modules through which the keys and values of a prompt pass, so that hooks can capture them."""

from collections.abc import Sequence
from typing import Any, cast

from torch import Tensor, nn


class Passage(nn.Module):
    """Hands on what it is given, the same tensor: a place for hooks, without weights and without arithmetic."""

    def forward(self, passing: Tensor) -> Tensor:
        """`passing`."""
        return passing


class PromptKV(nn.Module):
    """One passage for the keys and one for the values of every block.

    An inference sends what it keeps of the prompt through once: when the prompt is read, and before the part that
    acts reads it.
    """

    def __init__(self, blocks: int) -> None:
        super().__init__()
        self.keys = nn.ModuleList(Passage() for _ in range(blocks))
        self.values = nn.ModuleList(Passage() for _ in range(blocks))

    def forward(self, layers: Sequence[Any]) -> None:
        """Send through `keys` and `values` (B, H, T, E) of every layer of transformers' cache, block by block."""
        for layer, keys, values in zip(layers, self.keys, self.values, strict=True):
            layer.keys, layer.values = cast(Tensor, keys(layer.keys)), cast(Tensor, values(layer.values))
