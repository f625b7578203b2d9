"""The vision tower: patches of any grid, interpolated and rotary positions, full attention.

N patches of all pictures together, D width. The patches of a visual word follow each other.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from probe_kit.models.ovis2_5.config import VisionConfig

_THETA = 10000.0


class Embeddings(nn.Module):
    """Patches and where they stand, to width D."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.config = config
        self.patch_embedding = nn.Conv2d(3, config.width, config.patch, config.patch)
        self.position_embedding = nn.Embedding(config.table**2, config.width)

    def forward(self, patches: Tensor, grid: Tensor) -> Tensor:
        """(N, D) of (N, 3 · patch · patch)."""
        weight = self.patch_embedding.weight
        embedded = functional.linear(patches.to(weight.dtype), weight.flatten(1), self.patch_embedding.bias)
        return embedded + torch.cat([self._places(int(h), int(w)) for _, h, w in grid.tolist()])

    def _places(self, rows: int, columns: int) -> Tensor:
        side = self.config.table
        table = self.position_embedding.weight.view(1, side, side, -1).permute(0, 3, 1, 2)
        places = functional.interpolate(table, size=(rows, columns), mode="bicubic", align_corners=False)
        return word_order(places[0].permute(1, 2, 0), self.config.stride)


class Attention(nn.Module):
    """Attention of a picture's patches to each other."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.k_proj, self.v_proj = nn.Linear(width, width), nn.Linear(width, width)
        self.q_proj, self.out_proj = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, stream: Tensor, rotation: tuple[Tensor, Tensor], lengths: list[int]) -> Tensor:
        """(N, D). rotation: cosines and sines (N, 1, D / heads). lengths: patches of every picture."""
        query, key, value = (
            project(stream).unflatten(-1, (self.heads, -1)) for project in (self.q_proj, self.k_proj, self.v_proj)
        )
        query, key = _rotated(query, rotation), _rotated(key, rotation)
        pictures = zip(*(part.transpose(0, 1).split(lengths, dim=1) for part in (query, key, value)), strict=True)
        read = [functional.scaled_dot_product_attention(q[None], k[None], v[None])[0] for q, k, v in pictures]
        mixed: Tensor = self.out_proj(torch.cat(read, dim=1).transpose(0, 1).flatten(1))
        return mixed


def _rotated(heads: Tensor, rotation: tuple[Tensor, Tensor]) -> Tensor:
    cosines, sines = rotation
    wide = heads.float()
    first, second = wide.chunk(2, dim=-1)
    return (wide * cosines + torch.cat([-second, first], dim=-1) * sines).to(heads.dtype)


class Perceptron(nn.Module):
    """Two layers around a GELU."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, hidden), nn.Linear(hidden, width)

    def forward(self, stream: Tensor) -> Tensor:
        """(N, D)."""
        out: Tensor = self.fc2(functional.gelu(self.fc1(stream), approximate="tanh"))
        return out


class Block(nn.Module):
    """One layer, normed before each half."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.layer_norm1 = nn.LayerNorm(config.width, eps=config.epsilon)
        self.self_attn = Attention(config.width, config.heads)
        self.layer_norm2 = nn.LayerNorm(config.width, eps=config.epsilon)
        self.mlp = Perceptron(config.width, config.mlp)

    def forward(self, stream: Tensor, rotation: tuple[Tensor, Tensor], lengths: list[int]) -> Tensor:
        """(N, D)."""
        stream = stream + self.self_attn(self.layer_norm1(stream), rotation, lengths)
        out: Tensor = stream + self.mlp(self.layer_norm2(stream))
        return out


class Encoder(nn.Module):
    """The blocks."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Block(config) for _ in range(config.blocks))


class VisionModel(nn.Module):
    """The tower. `post_layernorm` is in the released files and never applied: what is read is the last stream."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.config = config
        self.embeddings = Embeddings(config)
        self.encoder = Encoder(config)
        self.post_layernorm = nn.LayerNorm(config.width, eps=config.epsilon)

    def forward(self, patches: Tensor, grid: Tensor) -> Tensor:
        """(N, D) of (N, 3 · patch · patch) and the grid (pictures, 3) they were cut in."""
        stream: Tensor = self.embeddings(patches, grid)
        rotation = self._rotation(grid, stream.device)
        lengths = grid.prod(dim=1).tolist()
        for block in self.encoder.layers:
            stream = block(stream, rotation, lengths)
        return stream

    def _rotation(self, grid: Tensor, device: torch.device) -> tuple[Tensor, Tensor]:
        """Cosines and sines (N, 1, D / heads): of half the angles by row, of the other half by column."""
        quarter = self.config.width // self.config.heads // 4
        exponents = torch.arange(0, 2 * quarter, 2, dtype=torch.float32, device=device) / (2 * quarter)
        frequencies = 1.0 / _THETA**exponents
        angles = []
        for _, rows, columns in grid.tolist():
            row = torch.arange(rows, device=device)[:, None].expand(rows, columns)
            column = torch.arange(columns, device=device)[None].expand(rows, columns)
            places = word_order(torch.stack([row, column], dim=-1), self.config.stride).float()
            angles.append((places[:, :, None] * frequencies).flatten(1))
        both = torch.cat(angles).repeat(1, 2)[:, None]
        return both.cos(), both.sin()


def word_order(maps: Tensor, stride: int) -> Tensor:
    """(rows · columns, …) of (rows, columns, …): the patches of one visual word follow each other."""
    rows, columns = maps.shape[:2]
    cut = maps.reshape(rows // stride, stride, columns // stride, stride, *maps.shape[2:])
    return cut.transpose(1, 2).reshape(rows * columns, *maps.shape[2:])
