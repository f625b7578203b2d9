"""The network: SigLIP, 3-D positions from ZoeDepth, a projection, Gemma-2 over image, text and actions.

B batch, P patches, T prompt tokens with the picture's, D width of the language model, V its vocabulary.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from transformers import DynamicCache, Gemma2ForCausalLM, SiglipVisionModel, ZoeDepthForDepthEstimation

from probe_kit.errors import UsageError, WeightsError
from probe_kit.models.building import build_empty, fill_decoder_rotary
from probe_kit.models.decoding import Decoded, TokenNetwork, greedy
from probe_kit.models.prompt_kv import PromptKV
from probe_kit.models.sizes_only import builds_sizes_only
from probe_kit.models.spatialvla.config import SpatialVLAConfig
from probe_kit.models.spatialvla.depth import Depth, estimate_depth, fill_depth_buffers
from probe_kit.models.spatialvla.space import PositionEmbedding3D, back_project

EAGER = "eager"
"""The only attention of transformers that keeps Gemma-2's soft cap of attention logits."""


class Projector(nn.Module):
    """Patch features to the language model's width."""

    def __init__(self, vision_width: int, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(vision_width, width)

    def forward(self, patches: Tensor) -> Tensor:
        """(B, P, D) from (B, P, vision width)."""
        projected: Tensor = self.linear(patches)
        return projected


@dataclass(frozen=True)
class Sight:
    """The stages of looking at pictures; depth and what follows from it is None without depth.

    tower: (B, P, vision width) SigLIP's normed patches. points: (B, P, 3R²) metres in the camera's frame.
    positions: (B, P, vision width) their embedding. features: (B, P, D) as the language model reads them.
    """

    tower: Tensor
    depth: Depth | None
    points: Tensor | None
    positions: Tensor | None
    features: Tensor


class SpatialVLANetwork(TokenNetwork):
    """A SpatialVLA under the parameter names of its released files."""

    def __init__(self, config: SpatialVLAConfig) -> None:
        super().__init__()
        self.config = config
        config.text._attn_implementation = EAGER
        width = int(config.vision.hidden_size)
        self.vision_tower: Any = SiglipVisionModel(config.vision)
        self.multi_modal_projector = Projector(width, int(config.text.hidden_size))
        self.language_model: Any = Gemma2ForCausalLM(config.text)
        self.prompt_kv = PromptKV(int(config.text.num_hidden_layers))
        if config.depth is not None:
            config.depth.backbone_config._attn_implementation = EAGER
            self.vision_zoe_model: Any = ZoeDepthForDepthEstimation(config.depth)
            self.position_embedding_3d = PositionEmbedding3D(3 * config.points**2, width, config.frequencies)
        if config.own_action_embeddings:
            self.spatial_embed_tokens = nn.Embedding(config.actions, int(config.text.hidden_size))

    @torch.no_grad()
    def embed_actions(self) -> None:
        """Give the action ids their own embeddings; to be called once weights are loaded.

        The released files hold them in a table of their own. Their rows in the language model's table are left
        from before training, and its output layer has rows of its own.
        """
        if self.config.own_action_embeddings:
            table = self.language_model.get_input_embeddings().weight
            table[self.config.first_action :] = self.spatial_embed_tokens.weight

    def look(self, pictures: Tensor, intrinsics: Tensor, vote: bool = False) -> Sight:
        """The features of (B, 3, S, S) float32 pictures in [0, 1], stage by stage.

        intrinsics: (3, 3) or (B, 3, 3) of cameras that take pictures of side S. vote: see `estimate_depth`.
        Pictures, depth and points are float32 whatever the weights are.
        """
        dtype = self.multi_modal_projector.linear.weight.dtype
        tower: Tensor = self.vision_tower(((pictures - 0.5) / 0.5).to(dtype)).last_hidden_state
        if self.config.depth is None:
            return Sight(tower, None, None, None, self.multi_modal_projector(tower))
        depth = estimate_depth(self.vision_zoe_model, pictures, vote)
        patch = int(self.config.vision.patch_size)
        points = back_project(depth.metres, intrinsics, patch, self.config.points)
        positions = self.position_embedding_3d(points)
        return Sight(tower, depth, points, positions, self.multi_modal_projector(tower + positions))

    def embed(self, ids: Tensor, features: Tensor | None = None) -> Tensor:
        """(B, T, D) embeddings of ids (B, T), with `features` (B, P, D) at the picture's positions.

        Gemma-2 multiplies its embeddings by √D inside the table; the original divides features by as much before
        it multiplies them, so they stay as they are. Raises UsageError if the ids have room for another number of
        patches.
        """
        embeddings: Tensor = self.language_model.get_input_embeddings()(ids)
        if features is None:
            return embeddings
        places = ids == self.config.image_token
        if places.sum(dim=1).tolist() != [features.shape[1]] * len(ids):
            raise UsageError(
                f"the prompts have {places.sum(dim=1).tolist()} places for a picture; expected {features.shape[1]}"
            )
        return embeddings.masked_scatter(places.unsqueeze(-1), features.to(embeddings.dtype))

    def forward(self, embeddings: Tensor, mask: Tensor, past: DynamicCache | None = None, keep: int = 0) -> Any:
        """transformers' output of one pass, with all hidden states if there is no `past`.

        embeddings: (B, T, D) of what is new; mask: (B, past + T) bool, False at padding. Everything given sees
        everything given and everything past, in both directions; padding is seen by nothing. keep: for how many of
        the last positions logits are made, 0 for all. Raises UsageError for an attention without the soft cap.
        """
        if (used := self.language_model.config._attn_implementation) != EAGER:
            raise UsageError(
                f"the language model's attention is {used!r}, which drops the soft cap of Gemma-2's attention "
                f"logits: activations would be others. Set it back to {EAGER!r}"
            )
        additive = _additive(mask, embeddings)
        return self.language_model(
            inputs_embeds=embeddings,
            position_ids=_positions(mask)[:, -embeddings.shape[1] :],
            attention_mask={"full_attention": additive, "sliding_attention": additive},
            past_key_values=past,
            use_cache=past is not None,
            logits_to_keep=keep,
            output_hidden_states=past is None,
        )

    def next_logits(self, embeddings: Tensor, mask: Tensor, cache: DynamicCache) -> Tensor:
        """See the base; its language model's mask is another one."""
        logits: Tensor = self(embeddings, mask, cache, keep=1).logits[:, -1]
        return logits

    def decode(
        self,
        ids: Tensor,
        mask: Tensor,
        features: Tensor,
        steps: int,
        slots: Sequence[range] | None = None,
        fed: Tensor | None = None,
    ) -> Decoded:
        """Exactly `steps` greedy tokens behind the prompt; see `decode_behind`.

        ids, mask: (B, T), with a token, not padding, at the end of every row. slots: per step the only ids that
        may be chosen.
        """
        turns = iter(slots or ())
        choose = greedy if slots is None else lambda logits: _best(logits, next(turns))
        return self.decode_behind(self.embed(ids, features), mask, steps, choose, fed)


def _best(logits: Tensor, allowed: range) -> Tensor:
    """(B,) the id of the largest logit of (B, V) among `allowed` ones."""
    return logits[:, allowed.start : allowed.stop].argmax(dim=-1) + allowed.start


def _positions(mask: Tensor) -> Tensor:
    """(B, T) positions from 1 that count tokens, not padding."""
    return mask.long().cumsum(dim=1).clamp(min=1)


def _additive(mask: Tensor, embeddings: Tensor) -> Tensor | None:
    """(B, 1, T, S) to be added to attention logits; None where nothing is hidden."""
    if bool(mask.all()):
        return None
    hidden = torch.zeros(mask.shape, dtype=embeddings.dtype, device=mask.device)
    hidden = hidden.masked_fill(~mask, torch.finfo(embeddings.dtype).min)
    return hidden[:, None, None].expand(-1, -1, embeddings.shape[1], -1)


def build_spatialvla(config: SpatialVLAConfig, dtype: torch.dtype, device: str = "meta") -> SpatialVLANetwork:
    """The network in eval mode.

    device: `meta` for a network whose parameters have names and shapes but no memory, to be filled with
    `load_weights(…, assign=True)`; `cpu` for one with uninitialised weights. `embed_actions` comes after
    the weights. Raises WeightsError if a part of transformers has a constant that would stay without memory.
    """
    network = build_empty(lambda: SpatialVLANetwork(config), dtype, device)
    if not builds_sizes_only():
        _fill_buffers(network)
    return network.eval()


def _fill_buffers(network: SpatialVLANetwork) -> None:
    """Fill in constants that no file holds."""
    decoder, tower = network.language_model.model, network.vision_tower.vision_model.embeddings
    fill_decoder_rotary(decoder)
    decoder.embed_tokens.embed_scale = torch.tensor(decoder.embed_tokens.scalar_embed_scale)
    tower.position_ids = torch.arange(tower.num_positions)[None]
    if network.config.depth is not None:
        fill_depth_buffers(network.vision_zoe_model)
    if empty := [name for name, buffer in network.named_buffers() if buffer.is_meta]:
        raise WeightsError(
            f"this version of transformers has constants unknown here: {', '.join(empty[:8])}. "
            "Use one that probe_kit names in its dependencies"
        )
