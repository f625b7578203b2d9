"""The network: one pass of Qwen3-VL over the prompt, then several passes of the flow transformer over its cache.

B batch, P prompt positions, A actions of a chunk, T = 1 + states + A positions of the flow transformer.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from transformers import Qwen3VLConfig, Qwen3VLForConditionalGeneration

from probe_kit.models.prompt_kv import PromptKV
from probe_kit.models.qwen import QwenInputs, build_empty, fill_rotary
from probe_kit.models.xiaomi.config import XiaomiConfig
from probe_kit.models.xiaomi.transformer import Cache, FlowTransformer, Projector, TimeEmbedder

STEPS = 5
"""Euler steps of the released software."""
_THOUSANDTHS = 1000


@dataclass(frozen=True)
class Prompt:
    """The parts of the prompt that the flow transformer keeps.

    caches: per layer it reads, keys and values. mask: (B, P) bool. ends: (3, B, 1) int64, the last position along
    time, height and width.
    """

    caches: list[Cache]
    mask: Tensor
    ends: Tensor


class XiaomiNetwork(nn.Module):
    """Xiaomi-Robotics-R0 under the parameter names of its released files."""

    def __init__(self, config: XiaomiConfig) -> None:
        super().__init__()
        flow = config.flow
        self.vlm: Any = Qwen3VLForConditionalGeneration._from_config(config.vlm, attn_implementation="eager")
        self.dit = FlowTransformer(flow.layers, flow.width, flow.head_dim, flow.cached_heads)
        self.state_projector = Projector(config.state_dim, flow.width)
        self.action_projector = Projector(config.action_dim, flow.width)
        self.action_output_layer = Projector(flow.width, config.action_dim)
        self.t_embedder = TimeEmbedder(flow.width)
        self.t_projector = Projector(flow.width, 6 * flow.width, layers=1, bias=True)
        self.sink = nn.Embedding(1, flow.width)
        self.prompt_kv = PromptKV(int(config.vlm.text_config.num_hidden_layers))

    def read(self, inputs: QwenInputs) -> Prompt:
        """One pass of the vision-language model; its output head is not called, nothing reads it."""
        keywords = inputs.keywords(self.vlm.model)
        cache = self.vlm.model(**keywords, use_cache=True).past_key_values
        self.prompt_kv(cache.layers)
        caches = [(layer.keys, layer.values) for layer in cache.layers[-len(self.dit.layers) :]]
        return Prompt(caches, inputs.mask.bool(), keywords["position_ids"].amax(dim=-1, keepdim=True))

    def velocity(self, prompt: Prompt, state: Tensor, actions: Tensor, moment: Tensor) -> Tensor:
        """(B, A, action numbers): where the actions of (B, A, action numbers) move at moment (B,) in [0, 1].

        state: (B, states, state numbers).
        """
        states, moving = self.state_projector(state), self.action_projector(actions)
        stream = torch.cat([self.sink.weight.expand(len(moving), -1, -1), states, moving], dim=1)
        time = self.t_projector(self.t_embedder(moment * _THOUSANDTHS)).unflatten(-1, (6, -1))
        length = stream.shape[1]
        positions = torch.arange(length, device=stream.device) + prompt.ends + 1
        rotation = self.vlm.model.language_model.rotary_emb(stream, positions)
        stream = self.dit(stream, prompt.caches, rotation, time, _mask(prompt.mask, length))
        velocity: Tensor = self.action_output_layer(stream[:, -actions.shape[1] :])
        return velocity

    def forward(
        self, inputs: QwenInputs, state: Tensor, used: Tensor, noise: Tensor, steps: int = STEPS
    ) -> Tensor:
        """(B, A, action numbers) float32 normalised actions: Euler steps from noise at moment 0 to moment 1.

        used: (B, A, action numbers), 1 where the robot has the number; it masks what the network reads of the
        moving actions, not what it puts out. noise: (B, A, action numbers) float32. The path is summed in float32
        whatever the weights are.
        """
        prompt = self.read(inputs)
        dtype = self.sink.weight.dtype
        path = noise.float()
        for step in range(steps):
            moment = torch.ones(len(path), device=path.device) * step / steps
            noisy = (path * used).to(dtype)
            path = path + self.velocity(prompt, state.to(dtype), noisy, moment).float() * (1.0 / steps)
        return path


def _mask(prompt: Tensor, length: int) -> Tensor:
    """(B, 1, T, P + T) bool: every own position sees the whole prompt, and of its own kind what stands before."""
    causal = torch.ones(length, length, dtype=torch.bool, device=prompt.device).tril()
    before = prompt[:, None, :].expand(-1, length, -1)
    return torch.cat([before, causal.expand(len(prompt), -1, -1)], dim=-1)[:, None]


def build_xiaomi(config: XiaomiConfig, dtype: torch.dtype, device: str = "meta") -> XiaomiNetwork:
    """The network in eval mode; see `build_empty`."""
    network = build_empty(lambda: XiaomiNetwork(config), dtype, device)
    fill_rotary(network.vlm)
    return network


def full_size_xiaomi() -> XiaomiNetwork:
    """The released size on the meta device: Qwen3-VL-4B and 16 layers of flow transformer."""
    vision = {
        "depth": 24,
        "hidden_size": 1024,
        "intermediate_size": 4096,
        "num_heads": 16,
        "out_hidden_size": 2560,
        "deepstack_visual_indexes": [5, 11, 17],
    }
    text = {
        "hidden_size": 2560,
        "intermediate_size": 9728,
        "num_hidden_layers": 36,
        "num_attention_heads": 32,
        "num_key_value_heads": 8,
        "head_dim": 128,
        "rope_parameters": {
            "rope_type": "default",
            "rope_theta": 5000000.0,
            "mrope_section": [24, 20, 20],
            "mrope_interleaved": True,
        },
    }
    vlm = Qwen3VLConfig(vision_config=vision, text_config=text, tie_word_embeddings=True)
    return build_xiaomi(
        XiaomiConfig.read({"vlm_config": vlm, "state_dim": 32, "action_dim": 32}, "released"), torch.float32
    )
