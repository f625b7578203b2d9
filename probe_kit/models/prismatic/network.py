"""The network: vision towers, projector, language model; image patches follow the first token.

B batch, P patches, T text tokens, S = P + T positions, D width of the language model, V its vocabulary.
"""

from typing import Any

import torch
from torch import Tensor, nn
from transformers import AutoModelForCausalLM

from probe_kit.models.building import build_empty, fill_decoder_rotary
from probe_kit.models.decoding import Choose, Decoded, TokenNetwork, greedy
from probe_kit.models.prismatic.config import PrismaticConfig
from probe_kit.models.prismatic.vision import VisionBackbone
from probe_kit.models.prompt_kv import PromptKV


class Projector(nn.Module):
    """Patch features to the language model's width: two layers for one tower, three for two."""

    def __init__(self, vision_width: int, width: int, fused: bool) -> None:
        super().__init__()
        hidden = 4 * vision_width if fused else width
        self.fc1 = nn.Linear(vision_width, hidden)
        self.fc2 = nn.Linear(hidden, width)
        self.fc3 = nn.Linear(width, width) if fused else None

    def forward(self, patches: Tensor) -> Tensor:
        """(B, P, D) from (B, P, vision width)."""
        projected: Tensor = self.fc2(nn.functional.gelu(self.fc1(patches)))
        return projected if self.fc3 is None else self.fc3(nn.functional.gelu(projected))


class PrismaticNetwork(TokenNetwork):
    """A Prismatic model under the parameter names of its released files."""

    def __init__(self, config: PrismaticConfig) -> None:
        super().__init__()
        self.config = config
        self.vision_backbone = VisionBackbone(config.towers)
        self.projector = Projector(self.vision_backbone.width, config.text.hidden_size, config.fused)
        self.language_model: Any = AutoModelForCausalLM.from_config(config.text, trust_remote_code=False)
        self.prompt_kv = PromptKV(int(config.text.num_hidden_layers))

    @property
    def patches(self) -> int:
        """P."""
        return int(self.vision_backbone.featurizer.patch_embed.num_patches)

    def embed(self, ids: Tensor, mask: Tensor, pixel_values: Tensor | None) -> tuple[Tensor, Tensor]:
        """Embeddings (B, S, D) and mask (B, S); without a picture S is T."""
        embeddings: Tensor = self.language_model.get_input_embeddings()(ids)
        if pixel_values is None:
            return embeddings, mask
        patches = self.projector(self.vision_backbone(pixel_values.to(embeddings.dtype)))
        patch_mask = torch.ones(patches.shape[:2], dtype=mask.dtype, device=mask.device)
        return (
            torch.cat([embeddings[:, :1], patches, embeddings[:, 1:]], dim=1),
            torch.cat([mask[:, :1], patch_mask, mask[:, 1:]], dim=1),
        )

    def forward(self, ids: Tensor, mask: Tensor, pixel_values: Tensor | None) -> Any:
        """transformers' output of one pass, with logits (B, S, V) and all hidden states.

        ids: (B, T). mask: (B, T) bool, False at padding, which may stand anywhere behind the first token.
        """
        return self.whole_pass(*self.embed(ids, mask, pixel_values))

    def decode(
        self, ids: Tensor, mask: Tensor, pixel_values: Tensor | None, steps: int, choose: Choose = greedy
    ) -> Decoded:
        """Exactly `steps` tokens behind the prompt; see `decode_behind`.

        ids, mask: as for `forward`, with a token, not padding, at the end of every row. choose: the next ids; the
        likeliest by default.
        """
        return self.decode_behind(*self.embed(ids, mask, pixel_values), steps, choose)


def build_prismatic(config: PrismaticConfig, dtype: torch.dtype, device: str = "meta") -> PrismaticNetwork:
    """The network in eval mode.

    device: `meta` for a network whose parameters have names and shapes but no memory, to be filled with
    `load_weights(…, assign=True)`; `cpu` for one with uninitialised weights.
    """
    network = build_empty(lambda: PrismaticNetwork(config), dtype, device)
    fill_decoder_rotary(network.language_model.model)
    network.language_model.tie_weights()
    return network.eval()


def full_size_openvla() -> PrismaticNetwork:
    """OpenVLA-7B on the meta device."""
    return _full_size("openvla", "dinosiglip-vit-so-224px", "llama2-7b-pure")


def full_size_prismatic() -> PrismaticNetwork:
    """Prismatic 7B with the fused towers on the meta device."""
    return _full_size("prismatic", "dinosiglip-vit-so-224px", "llama2-7b-pure")


def _full_size(model_type: str, vision: str, language: str) -> PrismaticNetwork:
    config = PrismaticConfig.from_json(
        {
            "model_type": model_type,
            "vision_backbone_id": vision,
            "llm_backbone_id": language,
            "text_config": {"vocab_size": 32064, "pad_token_id": 32000},
        }
    )
    return build_prismatic(config, torch.bfloat16)
