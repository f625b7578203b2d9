"""The network: vision tower, projector, language model; a picture's tokens take the place of its placeholder.

B batch, S positions, D width of the language model, V its vocabulary.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from transformers import LlamaForCausalLM

from probe_kit.models.building import build_empty, fill_decoder_rotary
from probe_kit.models.decoding import Choose, Decoded, TokenNetwork, greedy, last_logits
from probe_kit.models.magma.config import MagmaConfig
from probe_kit.models.magma.packing import PictureSpan, placeholder
from probe_kit.models.magma.pictures import Grid, Picture
from probe_kit.models.magma.vision import Projector, VisionTower, map_size, stitched, whole_picture
from probe_kit.models.packing import packed
from probe_kit.models.prompt_kv import PromptKV

# In the released files and never read: the contrastive head that the trunk was trained with.
UNUSED_WEIGHTS = (
    "vision_tower.clip_vision_model.head.proj.weight",
    "vision_tower.clip_vision_model.trunk.head.norm.bias",
    "vision_tower.clip_vision_model.trunk.head.norm.weight",
)


class MagmaNetwork(TokenNetwork):
    """Magma under the parameter names of its released files."""

    def __init__(self, config: MagmaConfig) -> None:
        super().__init__()
        self.config = config
        self.vision_tower = VisionTower(config.vision)
        self.multi_modal_projector = Projector(
            config.vision, self.vision_tower.width, int(config.text.hidden_size)
        )
        self.language_model: Any = LlamaForCausalLM(config.text)
        self.prompt_kv = PromptKV(int(config.text.num_hidden_layers))

    # -- pictures ----------------------------------------------------------------------------------------

    def span(self, ids: Sequence[int], grid: Grid, side: int) -> PictureSpan:
        """The positions of the tokens of a picture of `grid` crops of `side` pixels. Raises CheckpointError."""
        rows, columns = map_size(grid, side, self.vision_tower.reduction, self.config.vision.strategy)
        return PictureSpan(placeholder(ids, self.config.image_token), rows, columns)

    def trunk_input(self, picture: Picture) -> Tensor:
        """The trunk's input of a picture: its crops (N, 3, S, S), or all of it (1, 3, H, W)."""
        return whole_picture(picture) if self.config.vision.strategy == "global" else picture.crops

    def look(self, pictures: Sequence[Picture]) -> list[Tensor]:
        """Per picture its tokens (h · (w + 1), D), separators at the end of every row of its map."""
        reference = self.multi_modal_projector.row_seperator
        if self.config.vision.strategy == "global":
            maps = [self._projected(self.trunk_input(picture).to(reference))[0] for picture in pictures]
        else:
            crops = self._projected(torch.cat([picture.crops for picture in pictures]).to(reference))
            parts = torch.split(crops, [len(picture.crops) for picture in pictures])
            maps = [stitched(part, picture.grid) for part, picture in zip(parts, pictures, strict=True)]
        return [self.multi_modal_projector.tokens(projected) for projected in maps]

    def _projected(self, pixels: Tensor) -> Tensor:
        """(N, a, b, D)."""
        maps: Tensor = self.multi_modal_projector(self.vision_tower(pixels).permute(0, 2, 3, 1))
        return maps

    # -- text --------------------------------------------------------------------------------------------

    def embed(self, prompts: Sequence[Sequence[int]], pictures: Sequence[Picture] | None) -> tuple[Tensor, Tensor]:
        """Embeddings (B, S, D) and mask (B, S) of prompts, each with one placeholder where it has a picture.

        Raises CheckpointError.
        """
        embedding = self.language_model.get_input_embeddings()
        device = embedding.weight.device
        if pictures is None:
            return packed([embedding(torch.tensor(ids, device=device)) for ids in prompts])
        rows = []
        for ids, tokens in zip(prompts, self.look(pictures), strict=True):
            position = placeholder(ids, self.config.image_token)
            before, behind = (torch.tensor(part, device=device) for part in (ids[:position], ids[position + 1 :]))
            rows.append(torch.cat([embedding(before.long()), tokens, embedding(behind.long())]))
        return packed(rows)

    def forward(self, prompts: Sequence[Sequence[int]], pictures: Sequence[Picture] | None) -> Any:
        """transformers' output of one pass, with logits (B, S, V) and all hidden states."""
        return self.whole_pass(*self.embed(prompts, pictures))

    def decode(
        self,
        prompts: Sequence[Sequence[int]],
        pictures: Sequence[Picture] | None,
        steps: int,
        choose: Choose = greedy,
    ) -> Decoded:
        """Exactly `steps` tokens behind the prompts; see `decode_behind`."""
        return self.decode_behind(*self.embed(prompts, pictures), steps, choose)

    def unhooked(self) -> Any:
        """A second language model with the same weights and without hooks, so that nothing is captured."""
        with torch.device("meta"):
            twin = LlamaForCausalLM(self.config.text).requires_grad_(False)
        twin.load_state_dict(self.language_model.state_dict(keep_vars=True), strict=True, assign=True)
        twin.model.rotary_emb = self.language_model.model.rotary_emb
        return twin.eval()

    @staticmethod
    def logits_behind(decoded: Decoded, language_model: Any) -> Tensor:
        """(B, V) logits behind the last id, through another language model with the same weights.

        `decoded` cannot be continued afterwards: its cache has grown.
        """
        more = decoded.mask.new_ones(decoded.ids.shape)
        embeddings = language_model.get_input_embeddings()(decoded.ids[:, -1:])
        return last_logits(language_model, embeddings, torch.cat([decoded.mask, more], dim=1), decoded.cache)


def build_magma(config: MagmaConfig, dtype: torch.dtype, device: str = "meta") -> MagmaNetwork:
    """The network in eval mode.

    device: `meta` for a network whose parameters have names and shapes but no prompt_kv, to be filled with
    `load_weights(…, assign=True)`; `cpu` for one with uninitialised weights.
    Raises CheckpointError if the parts do not fit together.
    """
    network = build_empty(lambda: MagmaNetwork(config), dtype, device)
    fill_decoder_rotary(network.language_model.model)
    network.language_model.tie_weights()
    return network.eval()


def full_size_magma() -> MagmaNetwork:
    """Magma-8B on the meta device."""
    config = MagmaConfig.from_json(
        {
            "model_type": "magma",
            "image_token_index": 128257,
            "text_config": {
                "vocab_size": 128320,
                "hidden_size": 4096,
                "intermediate_size": 14336,
                "num_hidden_layers": 32,
                "num_attention_heads": 32,
                "num_key_value_heads": 8,
                "max_position_embeddings": 8192,
                "rope_theta": 500000.0,
                "rms_norm_eps": 1e-5,
                "bos_token_id": 128000,
                "eos_token_id": 128009,
                "pad_token_id": 128256,
            },
            "vision_config": {"vision_backbone": "convnextxxlarge", "mm_projector_type": "mlp2x_gelu"},
        }
    )
    return build_magma(config, torch.bfloat16)
