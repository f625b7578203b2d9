"""The flow transformer: attends to the vision-language model's keys and values; its output is an action velocity.

B batch, P prompt positions, T = 1 + states + actions own positions, D width, H heads of size E, K cached heads.
"""

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional
from transformers.models.qwen3_vl.modeling_qwen3_vl import (
    Qwen3VLTextRMSNorm,
    apply_rotary_pos_emb,
    repeat_kv,
)

from probe_kit.models.sinusoid import frequencies

Cache = tuple[Tensor, Tensor]
"""Keys and values of one layer of the vision-language model, (B, K, P, E) each, keys after rotation."""
Rotation = tuple[Tensor, Tensor]
"""Cosines and sines of the own positions, (B, T, E) each."""

_SINUSOID = 256
_LONGEST_PERIOD = 10000
_MODULATIONS = 6


class Projector(nn.Module):
    """One linear layer, or several with tanh-GELUs between them."""

    def __init__(self, inputs: int, outputs: int, layers: int = 2, bias: bool = False) -> None:
        super().__init__()
        stack: list[nn.Module] = [nn.Linear(inputs, outputs, bias=bias)]
        for _ in range(layers - 1):
            stack += [nn.GELU(approximate="tanh"), nn.Linear(outputs, outputs, bias=bias)]
        self.layers = nn.Sequential(*stack)

    def forward(self, features: Tensor) -> Tensor:
        """(…, outputs) from (…, inputs)."""
        return cast(Tensor, self.layers(features))


class TimeEmbedder(nn.Module):
    """A moment of the flow as a vector."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(_SINUSOID, width, bias=False), nn.SiLU(), nn.Linear(width, width, bias=False)
        )

    def forward(self, moments: Tensor) -> Tensor:
        """(B, D) of (B,) float32 moments in thousandths; cosines stand before sines."""
        angles = moments[:, None].float() * frequencies(_SINUSOID // 2, _LONGEST_PERIOD).to(moments.device)
        sinusoid = torch.cat([angles.cos(), angles.sin()], dim=-1)
        # The released model rounds the sinusoid to the precision of its weights.
        precision = next(self.mlp.parameters()).dtype
        return cast(Tensor, self.mlp(sinusoid.to(precision)))


class Attention(nn.Module):
    """Attention over the prompt's cached keys and values and the own ones behind them."""

    def __init__(self, width: int, head_dim: int, cached_heads: int) -> None:
        super().__init__()
        self.head_dim, self.heads = head_dim, width // head_dim
        self.repeats = self.heads // cached_heads
        self.qkv_proj = nn.Linear(width, 3 * width)
        self.o_proj = nn.Linear(width, width, bias=False)
        self.q_norm = Qwen3VLTextRMSNorm(head_dim)
        self.k_norm = Qwen3VLTextRMSNorm(head_dim)

    def forward(self, stream: Tensor, cache: Cache, rotation: Rotation, mask: Tensor) -> Tensor:
        """(B, T, D) from (B, T, D). mask: (B, 1, T, P + T) bool, True where a position is seen."""
        query, key, value = self._parts(stream, cache, rotation)
        read = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        return cast(Tensor, self.o_proj(read.transpose(1, 2).flatten(2)))

    def weights(self, stream: Tensor, cache: Cache, rotation: Rotation, mask: Tensor) -> Tensor:
        """(B, H, T, P + T) float32: what `forward` weighs with, computed once more."""
        query, key, _ = self._parts(stream, cache, rotation)
        logits = query.float() @ key.float().transpose(2, 3) * self.head_dim**-0.5
        return functional.softmax(logits.masked_fill(~mask, -torch.inf), dim=-1)

    def _parts(self, stream: Tensor, cache: Cache, rotation: Rotation) -> tuple[Tensor, Tensor, Tensor]:
        """Queries (B, H, T, E); keys and values (B, H, P + T, E), the prompt's first."""
        batch, length, _ = stream.shape
        parts = self.qkv_proj(stream).view(batch, length, 3, self.heads, self.head_dim)
        query, key, value = parts.unbind(2)
        query, key = (part.transpose(1, 2) for part in (self.q_norm(query), self.k_norm(key)))
        query, key = apply_rotary_pos_emb(query, key, *rotation)
        prompt_key, prompt_value = (repeat_kv(part, self.repeats) for part in cache)
        values = torch.cat([prompt_value, value.transpose(1, 2)], dim=-2)
        return query, torch.cat([prompt_key, key], dim=-2), values


class GatedMLP(nn.Module):
    """SwiGLU, four times as wide inside."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(width, 4 * width, bias=False)
        self.up_proj = nn.Linear(width, 4 * width, bias=False)
        self.down_proj = nn.Linear(4 * width, width, bias=False)

    def forward(self, stream: Tensor) -> Tensor:
        """(B, T, D) from (B, T, D)."""
        return cast(Tensor, self.down_proj(functional.silu(self.gate_proj(stream)) * self.up_proj(stream)))


class Gate(nn.Module):
    """Scales what is added to the stream; a module, so that hooks can capture what is added."""

    def forward(self, gate: Tensor, added: Tensor) -> Tensor:
        """(B, T, D) of gate (B, 1, D) and (B, T, D)."""
        return gate * added


class Layer(nn.Module):
    """Attention, then an MLP. Each writes into the stream through a gate, and the sum is normalised at once.

    There is therefore no stream that only adds: what leaves a layer has passed two norms in it.
    """

    def __init__(self, width: int, head_dim: int, cached_heads: int) -> None:
        super().__init__()
        self.attn = Attention(width, head_dim, cached_heads)
        self.mlp = GatedMLP(width)
        self.input_layernorm = Qwen3VLTextRMSNorm(width)
        self.middle_layernorm = Qwen3VLTextRMSNorm(width)
        self.post_layernorm = Qwen3VLTextRMSNorm(width)
        self.final_layernorm = Qwen3VLTextRMSNorm(width)
        self.attn_gate, self.mlp_gate = Gate(), Gate()
        self.adaln_table = nn.Parameter(torch.zeros(_MODULATIONS, width))

    def forward(self, stream: Tensor, cache: Cache, rotation: Rotation, moment: Tensor, mask: Tensor) -> Tensor:
        """(B, T, D) from (B, T, D). moment: (B, 6, D), the same for all layers."""
        modulation = (self.adaln_table + moment).chunk(_MODULATIONS, dim=1)
        shift, scale, gate = modulation[:3]
        read = self.attn(self.input_layernorm(stream) * (1 + scale) + shift, cache, rotation, mask)
        stream = self.middle_layernorm(stream + self.attn_gate(gate, read))
        shift, scale, gate = modulation[3:]
        written = self.mlp(self.post_layernorm(stream) * (1 + scale) + shift)
        return cast(Tensor, self.final_layernorm(stream + self.mlp_gate(gate, written)))


class FlowTransformer(nn.Module):
    """A stack of layers; layer k reads the cache of the k-th of the last layers of the vision-language model."""

    def __init__(self, layers: int, width: int, head_dim: int, cached_heads: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Layer(width, head_dim, cached_heads) for _ in range(layers))

    def forward(
        self, stream: Tensor, caches: list[Cache], rotation: Rotation, moment: Tensor, mask: Tensor
    ) -> Tensor:
        """(B, T, D) from (B, T, D). caches: one per layer."""
        for layer, cache in zip(self.layers, caches, strict=True):
            stream = layer(stream, cache, rotation, moment, mask)
        return stream
