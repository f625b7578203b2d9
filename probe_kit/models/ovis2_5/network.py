"""The network: patches become distributions over visual words, whose embeddings join those of the text.

B batch, T positions, N patches and W visual words of all pictures together, D width of the language model.
"""

from typing import Any

import torch
from torch import Tensor, nn
from transformers import Qwen3ForCausalLM

from probe_kit.models.building import build_empty, fill_decoder_rotary
from probe_kit.models.ovis2_5.config import OvisConfig
from probe_kit.models.ovis2_5.vision import VisionModel

PICTURE, PICTURE_BEGINS, PICTURE_ENDS = -300, -301, -302
"""What stands in the ids of a prompt where no text does."""
_MARKS = 4
"""Words that mark where pictures and videos begin and end; no patch ever becomes one."""


class Tower(nn.Module):
    """Holds the vision model under the name of released files."""

    def __init__(self, config: OvisConfig) -> None:
        super().__init__()
        self.vision_model = VisionModel(config.vision)


class VisualTokenizer(nn.Module):
    """The map from patches to distributions over visual words."""

    def __init__(self, config: OvisConfig) -> None:
        super().__init__()
        words = config.words - _MARKS
        self.joined = config.vision.stride**2
        self.vit = Tower(config)
        self.head = nn.Sequential(
            nn.Linear(config.vision.width * self.joined, words, bias=False), nn.LayerNorm(words)
        )

    def forward(self, patches: Tensor, grid: Tensor) -> Tensor:
        """(W, words without marks) float32 probabilities."""
        features = self.vit.vision_model(patches, grid)
        logits = self.head(features.reshape(len(features) // self.joined, -1))
        return torch.softmax(logits, dim=-1, dtype=torch.float32)


class OvisNetwork(nn.Module):
    """Ovis2.5 under the parameter names of its released files."""

    def __init__(self, config: OvisConfig) -> None:
        super().__init__()
        self.config = config
        self.llm: Any = Qwen3ForCausalLM(config.text)
        self.visual_tokenizer = VisualTokenizer(config)
        self.vte = nn.Embedding(config.words, int(config.text.hidden_size))

    def tie_weights(self) -> None:
        """Tie the language model's output weights, where its configuration says so."""
        self.llm.tie_weights()

    def embed(self, ids: Tensor, pixel_values: Tensor | None, grid: Tensor | None) -> Tensor:
        """(B, T, D) of ids (B, T), negative where a picture stands."""
        embeddings: Tensor = self.llm.get_input_embeddings()(ids.clamp(min=0))
        if pixel_values is None or grid is None:
            return embeddings
        words = self.vte.weight
        probabilities = self.visual_tokenizer(pixel_values, grid)
        visual = probabilities.to(words.dtype) @ words[:-_MARKS]
        embeddings = embeddings.masked_scatter((ids == PICTURE)[..., None], visual)
        for number, row in ((PICTURE_BEGINS, -_MARKS), (PICTURE_ENDS, 1 - _MARKS)):
            embeddings = torch.where((ids == number)[..., None], words[row], embeddings)
        return embeddings

    def forward(
        self,
        input_ids: Tensor,
        pixel_values: Tensor | None = None,
        image_grid_thw: Tensor | None = None,
        **keywords: Any,
    ) -> Any:
        """transformers' output of the language model. keywords: its own, such as masks and positions."""
        return self.llm(inputs_embeds=self.embed(input_ids, pixel_values, image_grid_thw), **keywords)


def build_ovis2_5(config: OvisConfig, dtype: torch.dtype, device: str = "meta") -> OvisNetwork:
    """The network in eval mode; see `build_empty`. Rotary frequencies, which no checkpoint holds, are computed."""
    network = build_empty(lambda: OvisNetwork(config), dtype, device)
    fill_decoder_rotary(network.llm.model)
    network.tie_weights()
    return network


def full_size_ovis2_5() -> OvisNetwork:
    """Ovis2.5-9B on the meta device."""
    text = {
        "model_type": "qwen3",
        "hidden_size": 4096,
        "intermediate_size": 12288,
        "num_hidden_layers": 36,
        "num_attention_heads": 32,
        "num_key_value_heads": 8,
        "head_dim": 128,
        "vocab_size": 151936,
    }
    vision = {
        "hidden_size": 1152,
        "intermediate_size": 4304,
        "num_hidden_layers": 27,
        "num_attention_heads": 16,
        "num_channels": 3,
        "patch_size": 16,
        "hidden_stride": 2,
        "image_size": 512,
        "window_size": 112,
        "temporal_patch_size": 1,
        "layer_norm_eps": 1e-6,
        "hidden_act": "gelu_pytorch_tanh",
        "use_rope": True,
        "preserve_original_pe": True,
        "fullatt_block_indexes": None,
    }
    values = {"llm_config": text, "vit_config": vision, "visual_vocab_size": 65536}
    return build_ovis2_5(OvisConfig.from_values(values), torch.float32)
