"""The network: one pass of Qwen2.5-VL and DINOv2, queries over both, and a guided diffusion head.

B batch, V views, P prompt positions, Q queries, A actions of a chunk.
"""

from typing import Any

import torch
from torch import Tensor, nn
from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

from probe_kit.models.internvla.config import FRAMEWORKS, DinoConfig, HeadConfig, InternVLAConfig, QueryConfig
from probe_kit.models.internvla.diffusion import DiffusionTransformer, Schedule, guided
from probe_kit.models.internvla.dino import DinoV2
from probe_kit.models.internvla.query import QueryTransformer
from probe_kit.models.qwen import QwenInputs, build_empty, fill_rotary


class _Qwen(nn.Module):
    def __init__(self, config: Qwen2_5_VLConfig) -> None:
        super().__init__()
        self.model: Any = Qwen2_5_VLForConditionalGeneration._from_config(config, attn_implementation="eager")


class _Dino(nn.Module):
    def __init__(self, config: DinoConfig) -> None:
        super().__init__()
        self.body = DinoV2(config)


class _Head(nn.Module):
    def __init__(self, config: HeadConfig, query: QueryConfig) -> None:
        super().__init__()
        self.net = DiffusionTransformer(config, query)


class InternVLANetwork(nn.Module):
    """InternVLA-M1 under the parameter names of its released files."""

    def __init__(self, config: InternVLAConfig) -> None:
        super().__init__()
        self.config = config
        self.qwen_vl_interface = _Qwen(config.vlm)
        self.layer_qformer = QueryTransformer(config.query)
        self.action_model = _Head(config.head, config.query)
        self.dino_encoder = _Dino(config.dino)
        self.dino_pro = nn.Linear(config.dino.width, config.vlm.text_config.hidden_size)

    @property
    def vlm(self) -> Any:
        """Qwen2.5-VL with its output head, which nothing calls."""
        return self.qwen_vl_interface.model

    @property
    def head(self) -> DiffusionTransformer:
        """The diffusion transformer."""
        return self.action_model.net

    def read(self, inputs: QwenInputs, views: Tensor) -> Tensor:
        """(B, Q, width of the queries): the condition of the actions.

        views: (B x V, 3, H, W) for DINOv2. The queries read hidden states of the vision-language model, of which
        the last is normed, with DINOv2's features behind each.
        """
        keywords = inputs.keywords(self.vlm.model)
        states = self.vlm.model(**keywords, output_hidden_states=True, use_cache=False).hidden_states
        features = self.dino_encoder.body(views.to(self.dino_pro.weight.dtype))
        projected = self.dino_pro(features.reshape(len(inputs.ids), -1, features.shape[-1]))
        read_states = states[self.config.query.first : self.config.query.last]
        condition: Tensor = self.layer_qformer([torch.cat([state, projected], dim=1) for state in read_states])
        return condition

    def denoise(self, condition: Tensor, noise: Tensor, schedule: Schedule, scale: float) -> Tensor:
        """(B, A, action numbers) float32 normalised actions.

        noise: of that shape, float32; the path is kept in float32 whatever the weights are. scale: of guidance;
        above 1 the head runs 2 B rows, first those with the condition, then those without.
        """
        rows = condition
        if guided(scale):
            without = self.head.z_embedder.uncondition.expand(len(condition), -1, -1)
            rows = torch.cat([condition, without.to(condition.dtype)])
        path = noise.float()
        for index in reversed(range(len(schedule))):
            steps = torch.full((len(rows),), int(schedule.moments[index]), device=path.device)
            noisy = path.repeat(len(rows) // len(path), 1, 1).to(condition.dtype)
            predicted = self.head(noisy, steps, rows).float()
            if guided(scale):
                with_condition, without_it = predicted.chunk(2)
                predicted = without_it + scale * (with_condition - without_it)
            path = schedule.back(index, path, predicted)
        return path


def build_internvla(config: InternVLAConfig, dtype: torch.dtype, device: str = "meta") -> InternVLANetwork:
    """The network in eval mode; see `build_empty`."""
    network = build_empty(lambda: InternVLANetwork(config), dtype, device)
    fill_rotary(network.vlm)
    return network


def full_size_internvla() -> InternVLANetwork:
    """The released size on the meta device: Qwen2.5-VL-3B, DINOv2 ViT-S, 64 queries, DiT-B."""
    vision = {
        "depth": 32,
        "hidden_size": 1280,
        "intermediate_size": 3420,
        "num_heads": 16,
        "out_hidden_size": 2048,
    }
    text = {
        "vocab_size": 151936,
        "hidden_size": 2048,
        "intermediate_size": 11008,
        "num_hidden_layers": 36,
        "num_attention_heads": 16,
        "num_key_value_heads": 2,
        "rope_parameters": {"rope_type": "default", "rope_theta": 1000000.0, "mrope_section": [16, 24, 24]},
    }
    queries = {
        "qformer_start_layer": 36, "qformer_end_layer": 37, "num_query_tokens": 64, "input_dim": 2048,
        "output_dim": 768,
    }  # fmt: skip
    run = {"framework": {"framework_py": FRAMEWORKS[0], "layer_qformer": queries}}
    vlm = {"vision_config": vision, "text_config": text, "tie_word_embeddings": True}
    return build_internvla(InternVLAConfig.from_values(run, vlm, "released"), torch.float32)
