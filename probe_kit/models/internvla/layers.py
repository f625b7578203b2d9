"""Attention and MLP of the blocks of InternVLA-M1's diffusion head and vision tower."""

from typing import Literal, cast

from torch import Tensor, nn
from torch.nn import functional


class Attention(nn.Module):
    """Self-attention of (B, T, D) without a mask."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, stream: Tensor) -> Tensor:
        """(B, T, D)."""
        query, key, value = self.qkv(stream).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        read = functional.scaled_dot_product_attention(query, key, value)
        return cast(Tensor, self.proj(read.transpose(1, 2).flatten(2)))


class MLP(nn.Module):
    """Two layers with GELU between them. approximate: torch's name of its approximation."""

    def __init__(self, width: int, approximate: Literal["none", "tanh"]) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)
        self.approximate = approximate

    def forward(self, stream: Tensor) -> Tensor:
        """(B, T, D)."""
        return cast(Tensor, self.fc2(functional.gelu(self.fc1(stream), approximate=self.approximate)))
