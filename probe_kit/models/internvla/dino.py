"""DINOv2 with its authors' parameter names and interpolation of learned positions.

B batch, P patches, D width.
"""

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from probe_kit.models.internvla.config import DinoConfig
from probe_kit.models.internvla.layers import MLP, Attention

_EPSILON = 1e-6
_OFFSET = 0.1
"""Added to the number of patches before dividing, in the original, against rounding down."""


class _Scale(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, stream: Tensor) -> Tensor:
        return stream * self.gamma


class Block(nn.Module):
    """A pre-norm block whose two halves are scaled per feature before they are added."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=_EPSILON)
        self.attn = Attention(width, heads)
        self.ls1 = _Scale(width)
        self.norm2 = nn.LayerNorm(width, eps=_EPSILON)
        self.mlp = MLP(width, "none")
        self.ls2 = _Scale(width)

    def forward(self, stream: Tensor) -> Tensor:
        """(B, 1 + P, D) from (B, 1 + P, D)."""
        stream = stream + self.ls1(self.attn(self.norm1(stream)))
        return cast(Tensor, stream + self.ls2(self.mlp(self.norm2(stream))))


class _PatchEmbedding(nn.Module):
    def __init__(self, width: int, patch: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, kernel_size=patch, stride=patch)

    def forward(self, pixels: Tensor) -> Tensor:
        return cast(Tensor, self.proj(pixels).flatten(2).transpose(1, 2))


class DinoV2(nn.Module):
    """The vision transformer; patch features come behind its final norm, the class token stays behind."""

    def __init__(self, config: DinoConfig) -> None:
        super().__init__()
        self.patch = config.patch
        self.cls_token = nn.Parameter(torch.zeros(1, 1, config.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, (config.trained_side // config.patch) ** 2 + 1, config.width))
        self.mask_token = nn.Parameter(torch.zeros(1, config.width))
        self.patch_embed = _PatchEmbedding(config.width, config.patch)
        self.blocks = nn.ModuleList(Block(config.width, config.heads) for _ in range(config.blocks))
        self.norm = nn.LayerNorm(config.width, eps=_EPSILON)

    def forward(self, pixels: Tensor) -> Tensor:
        """(B, P, D) from (B, 3, H, W), both sides multiples of the patch."""
        patches = self.patch_embed(pixels)
        stream = torch.cat([self.cls_token.expand(len(pixels), -1, -1), patches], dim=1)
        rows, columns = (side // self.patch for side in pixels.shape[-2:])
        stream = stream + self._positions(rows, columns).to(stream.dtype)
        for block in self.blocks:
            stream = block(stream)
        return cast(Tensor, self.norm(stream)[:, 1:])

    def _positions(self, rows: int, columns: int) -> Tensor:
        """(1, 1 + rows x columns, D): the learned grid, stretched where the picture has another one."""
        trained = round((self.pos_embed.shape[1] - 1) ** 0.5)
        if rows == columns == trained:
            return self.pos_embed
        embeddings = self.pos_embed.float()
        grid = embeddings[:, 1:].reshape(1, trained, trained, -1).permute(0, 3, 1, 2)
        factors = ((rows + _OFFSET) / trained, (columns + _OFFSET) / trained)
        stretched = functional.interpolate(grid, scale_factor=factors, mode="bicubic")
        return torch.cat([embeddings[:, :1], stretched.flatten(2).transpose(1, 2)], dim=1)
