"""The diffusion head: a transformer over condition and noisy actions, with guidance and DDIM sampling.

B batch, C conditions, A actions of a chunk, N denoising steps, D width.
"""

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.models.internvla.config import HeadConfig, QueryConfig
from probe_kit.models.internvla.layers import MLP, Attention
from probe_kit.models.sinusoid import frequencies

_SINUSOID = 256
_LONGEST_PERIOD = 10000
_EPSILON = 1e-6


def _norm(width: int) -> nn.LayerNorm:
    return nn.LayerNorm(width, eps=_EPSILON, elementwise_affine=False)


class TimeEmbedder(nn.Module):
    """A step of the diffusion as a vector."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(_SINUSOID, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, steps: Tensor) -> Tensor:
        """(B, D) of (B,) int64; cosines stand before sines."""
        angles = steps[:, None].float() * frequencies(_SINUSOID // 2, _LONGEST_PERIOD).to(steps.device)
        sinusoid = torch.cat([angles.cos(), angles.sin()], dim=-1)
        return cast(Tensor, self.mlp(sinusoid.to(next(self.mlp.parameters()).dtype)))


class _Embedder(nn.Module):
    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, width)

    def forward(self, features: Tensor) -> Tensor:
        return cast(Tensor, self.linear(features))


class _ConditionEmbedder(_Embedder):
    """Also holds the condition that stands for none."""

    def __init__(self, inputs: int, width: int, conditions: int) -> None:
        super().__init__(inputs, width)
        self.uncondition = nn.Parameter(torch.zeros(conditions, inputs))


class Block(nn.Module):
    """A pre-norm block; its norms have no weights."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = _norm(width), _norm(width)
        self.attn = Attention(width, heads)
        self.mlp = MLP(width, "tanh")

    def forward(self, stream: Tensor) -> Tensor:
        """(B, C + A, D) from (B, C + A, D)."""
        stream = stream + self.attn(self.norm1(stream))
        return cast(Tensor, stream + self.mlp(self.norm2(stream)))


class FinalLayer(nn.Module):
    """The map from the stream to the noise in every position."""

    def __init__(self, width: int, outputs: int) -> None:
        super().__init__()
        self.norm_final = _norm(width)
        self.linear = nn.Linear(width, outputs)

    def forward(self, stream: Tensor) -> Tensor:
        """(B, C + A, action numbers) from (B, C + A, D)."""
        return cast(Tensor, self.linear(self.norm_final(stream)))


class DiffusionTransformer(nn.Module):
    """Conditions, each with the step added, stand before the noisy actions; everything sees everything."""

    def __init__(self, config: HeadConfig, query: QueryConfig) -> None:
        super().__init__()
        self.conditions = query.queries
        self.positional_embedding = nn.Parameter(torch.zeros(query.queries + config.length, config.width))
        # Of a version that read past actions; inference never calls it.
        self.history_embedder = _Embedder(config.action_dim, config.width)
        self.x_embedder = _Embedder(config.action_dim, config.width)
        self.t_embedder = TimeEmbedder(config.width)
        self.z_embedder = _ConditionEmbedder(query.width, config.width, query.queries)
        self.blocks = nn.ModuleList(Block(config.width, config.heads) for _ in range(config.blocks))
        self.final_layer = FinalLayer(config.width, config.action_dim)

    def forward(self, actions: Tensor, steps: Tensor, condition: Tensor) -> Tensor:
        """(B, A, action numbers) of noise in actions of that shape. condition: (B, C, width of the queries)."""
        conditions = self.t_embedder(steps)[:, None] + self.z_embedder(condition)
        stream = torch.cat([conditions, self.x_embedder(actions)], dim=1) + self.positional_embedding
        for block in self.blocks:
            stream = block(stream)
        return cast(Tensor, self.final_layer(stream)[:, self.conditions :])


def guided(scale: float) -> bool:
    """Whether the head runs twice the rows: with the condition and, below them, without."""
    return scale > 1


@dataclass(frozen=True)
class Schedule:
    """DDIM's steps: what each tells the network, ascending, and the share of signal left there, (N,) float64."""

    moments: NDArray[np.int64]
    signal: NDArray[np.float64]

    @classmethod
    def of(cls, steps: int, trained: int, name: str = "squaredcos_cap_v2") -> "Schedule":
        """`steps` of the `trained` ones at a whole distance.

        Raises CheckpointError for another noise schedule, UsageError where no whole distance gives that number.
        """
        if name != "squaredcos_cap_v2":
            raise CheckpointError(f"noise schedule {name!r} is not implemented here; only squaredcos_cap_v2 is")
        distances = [stride for stride in range(1, trained + 1) if len(range(0, trained, stride)) == steps]
        if not distances:
            raise UsageError(
                f"{steps} DDIM steps cannot be taken at a whole distance out of {trained}; try 5 or 10"
            )
        moments = np.arange(0, trained, distances[0])
        return cls(moments, np.cumprod(1 - _added_noise(trained))[moments])

    def __len__(self) -> int:
        return len(self.moments)

    def back(self, index: int, path: Tensor, noise: Tensor) -> Tensor:
        """Return the path one step below `index`, without new noise; below the lowest there is signal only."""
        signal = float(self.signal[index])
        below = float(self.signal[index - 1]) if index else 1.0
        clean = math.sqrt(1 / signal) * path - math.sqrt(1 / signal - 1) * noise
        return clean * math.sqrt(below) + math.sqrt(1 - below) * noise


def _added_noise(steps: int) -> NDArray[np.float64]:
    """(steps,) variance each step adds; the signal falls as a squared cosine (Nichol and Dhariwal 2021)."""

    def left(share: float) -> float:
        return math.cos((share + 0.008) / 1.008 * math.pi / 2) ** 2

    return np.array([min(1 - left((step + 1) / steps) / left(step / steps), 0.999) for step in range(steps)])
