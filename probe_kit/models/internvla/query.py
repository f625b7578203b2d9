"""The querying transformer: learned queries attend to the vision-language model's hidden states, layer by layer.

B batch, Q queries, S positions that are read, D width.
"""

from typing import cast

import torch
from torch import Tensor, nn

from probe_kit.models.internvla.config import QueryConfig


class Layer(nn.Module):
    """Queries read one hidden state, then pass an MLP."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width)
        self.cross_attn = nn.MultiheadAttention(width, heads, batch_first=True)
        self.norm2 = nn.LayerNorm(width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, queries: Tensor, read: Tensor) -> Tensor:
        """(B, Q, D) from (B, Q, D) and (B, S, D)."""
        queries = queries + self.cross_attn(self.norm1(queries), read, read, need_weights=False)[0]
        return cast(Tensor, queries + self.mlp(self.norm2(queries)))


class QueryTransformer(nn.Module):
    """One layer per hidden state. No mask hides padding: a padded prompt changes what the queries find."""

    def __init__(self, config: QueryConfig) -> None:
        super().__init__()
        self.proj = nn.Linear(config.inputs, config.width)
        self.query_tokens = nn.Parameter(torch.zeros(config.queries, config.width))
        self.layers = nn.ModuleList(Layer(config.width, config.heads) for _ in range(config.last - config.first))

    def forward(self, states: list[Tensor]) -> Tensor:
        """(B, Q, D) from one (B, S, width of the vision-language model) per layer."""
        # A copy: what an edit writes into the stream must not land in the parameter.
        queries = self.query_tokens.expand(len(states[0]), -1, -1).clone()
        for layer, state in zip(self.layers, states, strict=True):
            queries = layer(queries, self.proj(state))
        return queries
