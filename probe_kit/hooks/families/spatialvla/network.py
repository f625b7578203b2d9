"""SpatialVLA in plain torch and transformers: SigLIP, ZoeDepth, a 3-D position, Gemma-2, actions as tokens.

Names of modules and parameters are those of the released files, so that a checkpoint loads as it is. Capture and
actions are in its adapter in `probe_kit.hooks`. The three networks inside are described as transformers describes
them. Fields that their parts leave out have the defaults that transformers had when the file was written.

B batch, P patches, R points per patch and direction, T prompt tokens with the picture's, D width of the language
model, V its vocabulary.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import Field, InstanceOf, model_validator
from torch import Tensor, nn
from transformers import (
    DynamicCache,
    Gemma2Config,
    Gemma2ForCausalLM,
    SiglipVisionConfig,
    SiglipVisionModel,
    ZoeDepthConfig,
    ZoeDepthForDepthEstimation,
)

from probe_kit.errors import CheckpointError, UsageError, WeightsError
from probe_kit.models.building import build_empty, builds_sizes_only, fill_decoder_rotary
from probe_kit.models.checkpoint_files import picture_values
from probe_kit.models.config_file import STORED_TYPE, ConfigFile, Count, Index, part
from probe_kit.models.decoding import Decoded, PromptKV, TokenNetwork, greedy

MODEL_TYPE = "spatialvla"
_DEPTH = ("vision_zoe_config", "ego3d_patch_reso")


class SpatialVLAConfig(ConfigFile):
    """A checkpoint's configuration.

    Attributes:
        text: Transformers' configuration of Gemma-2.
        vision: Transformers' configuration of SigLIP.
        depth: Transformers' configuration of ZoeDepth; None for a model that sees no depth.
        projected: The width of a patch for the language model.
        image_token: The id whose positions the picture takes.
        first_action: The first id that names an action; these ids end the vocabulary.
        actions: Number of ids that name actions.
        own_action_embeddings: Whether those ids have a table of embeddings to themselves.
        points: 3-D points per patch and direction.
        frequencies: Frequencies of the points' code.
    """

    model_types = (MODEL_TYPE,)
    network = "SpatialVLA"

    text: Annotated[InstanceOf[Gemma2Config], part(Gemma2Config.from_dict, "gemma2")] = Field(
        validation_alias="text_config"
    )
    vision: Annotated[
        InstanceOf[SiglipVisionConfig], part(SiglipVisionConfig.from_dict, "siglip_vision_model")
    ] = Field(validation_alias="vision_config")
    depth: Annotated[InstanceOf[ZoeDepthConfig] | None, part(ZoeDepthConfig.from_dict, "zoedepth")] = Field(
        default=None, validation_alias="vision_zoe_config"
    )
    projected: Count = Field(validation_alias="projection_dim")
    image_token: Index = Field(validation_alias="image_token_index")
    first_action: Index = Field(validation_alias="action_token_begin_idx")
    actions: Count = Field(validation_alias="spatial_token_num")
    own_action_embeddings: bool = Field(default=False, validation_alias="use_spatial_token")
    points: Count = Field(default=1, validation_alias="ego3d_patch_reso")
    frequencies: Count = Field(default=8, validation_alias="n_freqs")
    beginning: Index = Field(default=2, validation_alias="bos_token_id")
    padding: Index = Field(default=0, validation_alias="pad_token_id")
    dtype: str | None = STORED_TYPE

    @property
    def side(self) -> int:
        """The side of the square picture that the model sees, in pixels."""
        return int(self.vision.image_size)

    @property
    def patches(self) -> int:
        """The number of patches of one picture."""
        return (self.side // int(self.vision.patch_size)) ** 2

    @model_validator(mode="before")
    @classmethod
    def _depth_is_seen_or_not(cls, values: dict[str, Any]) -> dict[str, Any]:
        if not values.get("use_vision_zoe", True):
            return {name: value for name, value in values.items() if name != "vision_zoe_config"}
        if missing := [name for name in _DEPTH if values.get(name) is None]:
            raise ValueError(f"{', '.join(missing)} is missing")
        return values

    @model_validator(mode="after")
    def _fits(self) -> Self:
        width, vocabulary = int(self.text.hidden_size), int(self.text.vocab_size)
        last, patch = self.first_action + self.actions, int(self.vision.patch_size)
        wrong = {
            f"projection_dim {self.projected} is not the language model's width {width}": self.projected != width,
            f"action ids end at {last}, the vocabulary at {vocabulary}": last != vocabulary,
            f"image_token_index {self.image_token} is an action": self.image_token >= self.first_action,
            f"{self.points} points do not divide a patch of {patch} pixels": patch % self.points != 0,
            "text_config ties the output layer to the embeddings": self.text.tie_word_embeddings,
        }
        if contradictions := [sentence for sentence, is_wrong in wrong.items() if is_wrong]:
            raise ValueError("; ".join(contradictions))
        return self


# -- depth ----------------------------------------------------------------------------------------------------

# The original fixes both in its code; no file of a checkpoint names them.
MARGIN = 31
"""Pixels of mirrored picture on every side, so that the map has no border effects."""
DEPTH_SIDE = 384
"""Side of the picture that ZoeDepth sees, in pixels."""


@dataclass(frozen=True)
class Depth:
    """The depth of pictures by ZoeDepth, float32.

    Attributes:
        metres: (B, 1, S, S) depth in metres.
        raw: (B, H, W) as predicted, with the margin.
        domains: (B, 2) logits for indoor and outdoor scenes, which choose the head that measures; None for a
            ZoeDepth of one head.
    """

    metres: Tensor
    raw: Tensor
    domains: Tensor | None


def depth_input(pictures: Tensor) -> Tensor:
    """Return pictures (B, 3, S, S) in [0, 1] as (B, 3, 384, 384) in [-1, 1]."""
    padded = nn.functional.pad(pictures, (MARGIN, MARGIN, MARGIN, MARGIN), mode="reflect")
    resized = nn.functional.interpolate(padded, size=(DEPTH_SIDE, DEPTH_SIDE), mode="bicubic", align_corners=True)
    return (resized - 0.5) / 0.5


def estimate_depth(network: Any, pictures: Tensor, vote: bool = False) -> Depth:
    """Return the depth of pictures.

    Args:
        network: A `ZoeDepthForDepthEstimation`.
        pictures: (B, 3, S, S) float32 in [0, 1].
        vote: Let the batch choose one head for all its pictures, as the original does. Without it every picture
            has the head it would have alone, so that a row does not depend on the others in its batch.
    """
    side, dtype = pictures.shape[-1], next(network.parameters()).dtype
    pixels = depth_input(pictures).to(dtype)
    raw, domains = _predict(network, pixels)
    if domains is not None and not vote:
        domain_of_row, common = domains.argmax(dim=-1), int(domains.sum(dim=0).argmax())
        for domain in set(domain_of_row.tolist()):
            if domain != common:  # rows of one domain alone: their sum has the same largest logit
                raw[domain_of_row == domain] = _predict(network, pixels[domain_of_row == domain])[0]
    metres = nn.functional.interpolate(
        raw[:, None], size=(side + 2 * MARGIN,) * 2, mode="bicubic", align_corners=True
    )
    return Depth(metres[..., MARGIN:-MARGIN, MARGIN:-MARGIN], raw, domains)


def _predict(network: Any, pixels: Tensor) -> tuple[Tensor, Tensor | None]:
    output = network(pixel_values=pixels)
    domains = output.domain_logits
    return output.predicted_depth.float(), None if domains is None else domains.float()


def fill_depth_buffers(network: Any) -> None:
    """Give a network built without memory the constants that no file holds."""
    for module in network.modules():
        if "k_idx" in dict(module.named_buffers(recurse=False)):
            module.k_idx = torch.arange(module.k).view(1, -1, 1, 1)
            module.k_minus_1 = torch.tensor([module.k - 1]).view(1, -1, 1, 1)


# -- space ----------------------------------------------------------------------------------------------------

# The box the code is made for: two metres to each side, four metres ahead of the camera.
_CENTRE, _HALF = (0.0, 0.0, 2.0), 2.0


def point_places(side: int, patch: int, points: int) -> Tensor:
    """Return pixel places u, v and 1 of the middles of a patch's `points`² parts, row by row, (3, N) float32."""
    step = patch // points
    middles = torch.arange(0, side, step) + patch / points / 2
    v, u = torch.meshgrid(middles, middles, indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)]).flatten(1).float()


def back_project(metres: Tensor, intrinsics: Tensor, patch: int, points: int) -> Tensor:
    """Return points (B, P, 3R²) in metres in the camera's frame: per patch, x, y, z of its points, row by row.

    Args:
        metres: (B, 1, S, S) depth in metres.
        intrinsics: (3, 3) or (B, 3, 3) for a picture of side S.
        patch: Side of a patch in pixels.
        points: Number R of points per patch and direction.
    """
    side = metres.shape[-1]
    along = side // patch
    places = point_places(side, patch, points).to(metres.device)
    depth = nn.functional.interpolate(metres, size=(along * points,) * 2, mode="area").flatten(2)
    cloud = (torch.linalg.inv(intrinsics.float()) @ places) * depth
    grouped: Tensor = cloud.reshape(-1, 3, along, points, along, points).permute(0, 2, 4, 3, 5, 1)
    return grouped.reshape(len(metres), along * along, -1)


class PositionEmbedding3D(nn.Module):
    """The embedding of points: sines and cosines of rising frequency, then two layers to the tower's width."""

    def __init__(self, coordinates: int, width: int, frequencies: int) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.position_embedding_head = nn.Sequential(
            nn.Linear(coordinates * (2 * frequencies + 1), width),
            nn.LayerNorm(width),
            nn.ReLU(),
            nn.Linear(width, width),
        )

    def code(self, points: Tensor) -> Tensor:
        """Return the code (B, P, C · (2F + 1)) of coordinates (B, P, C): of each its value, F sines, F cosines."""
        centre = torch.tensor(_CENTRE, device=points.device).repeat(points.shape[-1] // 3)
        placed = ((points - centre) / _HALF).unsqueeze(-1)
        angles = placed * 2.0 ** torch.arange(self.frequencies, device=points.device)
        return torch.cat([placed, angles.sin(), angles.cos()], dim=-1).flatten(2)

    def forward(self, points: Tensor) -> Tensor:
        """Return the embeddings (B, P, width), in the dtype of the weights, of (B, P, C) float32 metres."""
        dtype = next(self.parameters()).dtype
        embedded: Tensor = self.position_embedding_head(self.code(points).to(dtype))
        return embedded


# -- the network ----------------------------------------------------------------------------------------------

EAGER = "eager"
"""The only attention of transformers that keeps Gemma-2's soft cap of attention logits."""


class Projector(nn.Module):
    """The map of patch features to the language model's width."""

    def __init__(self, vision_width: int, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(vision_width, width)

    def forward(self, patches: Tensor) -> Tensor:
        """Return the patches in the language model's width, (B, P, D) from (B, P, vision width)."""
        projected: Tensor = self.linear(patches)
        return projected


@dataclass(frozen=True)
class Sight:
    """The stages of looking at pictures; depth and the stages after it are None without depth.

    Attributes:
        tower: (B, P, vision width) SigLIP's normed patches.
        points: (B, P, 3R²) metres in the camera's frame.
        positions: (B, P, vision width) embedding of the points.
        features: (B, P, D) features that the language model reads.
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
        """Return the features of pictures, stage by stage.

        Pictures, depth and points are float32 whatever the weights are.

        Args:
            pictures: (B, 3, S, S) float32 in [0, 1].
            intrinsics: (3, 3) or (B, 3, 3) of cameras that take pictures of side S.
            vote: As in `estimate_depth`.
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
        """Return the embeddings (B, T, D) of ids (B, T), with `features` (B, P, D) at the picture's positions.

        Gemma-2 multiplies its embeddings by √D inside the table; the original divides features by as much before
        it multiplies them, so they stay as they are.

        Raises:
            UsageError: If the ids have room for another number of patches.
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
        """Return the output of transformers for one pass, with all hidden states if there is no `past`.

        Every new token sees every new token and all of the past, in both directions; no token sees padding.

        Args:
            embeddings: (B, T, D) embeddings of the new tokens.
            mask: (B, past + T) bool, False at padding.
            past: Keys and values of earlier tokens; None without any.
            keep: Number of last positions for which logits are made, 0 for all.

        Raises:
            UsageError: For an attention without the soft cap.
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
        """Return the logits (B, V) behind the last position, with the mask of `forward`."""
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
        """Return exactly `steps` greedy tokens behind the prompt; see `decode_behind`.

        Args:
            ids: (B, T) ids, with the picture's.
            mask: (B, T) bool, False at padding; every row ends with a token, not padding.
            features: (B, P, D) features of the pictures.
            steps: Number of tokens.
            slots: Ids that may be chosen at each step; None for all.
            fed: (B, steps - 1) ids to feed back instead of those chosen.
        """
        turns = iter(slots or ())
        choose = greedy if slots is None else lambda logits: _best(logits, next(turns))
        return self.decode_behind(self.embed(ids, features), mask, steps, choose, fed)


def _best(logits: Tensor, allowed: range) -> Tensor:
    """Return the id (B,) of the largest logit of (B, V) among `allowed` ones."""
    return logits[:, allowed.start : allowed.stop].argmax(dim=-1) + allowed.start


def _positions(mask: Tensor) -> Tensor:
    """Return positions (B, T) from 1 that count tokens, not padding."""
    return mask.long().cumsum(dim=1).clamp(min=1)


def _additive(mask: Tensor, embeddings: Tensor) -> Tensor | None:
    """Return the mask (B, 1, T, S) that is added to attention logits; None where nothing is hidden."""
    if bool(mask.all()):
        return None
    hidden = torch.zeros(mask.shape, dtype=embeddings.dtype, device=mask.device)
    hidden = hidden.masked_fill(~mask, torch.finfo(embeddings.dtype).min)
    return hidden[:, None, None].expand(-1, -1, embeddings.shape[1], -1)


def build_spatialvla(config: SpatialVLAConfig, dtype: torch.dtype, device: str = "meta") -> SpatialVLANetwork:
    """Return the network in eval mode; see `build_empty`. `embed_actions` comes after the weights.

    Raises:
        WeightsError: If a part of transformers has a constant that would stay without memory.
    """
    network = build_empty(lambda: SpatialVLANetwork(config), dtype, device)
    if not builds_sizes_only():
        _fill_buffers(network)
    return network.eval()


def _fill_buffers(network: SpatialVLANetwork) -> None:
    """Fill in constants that no file holds.

    Raises:
        WeightsError: If a constant is unknown here.
    """
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


# -- the size of the release ----------------------------------------------------------------------------------

_VISION = {
    "hidden_size": 1152,
    "image_size": 224,
    "intermediate_size": 4304,
    "num_attention_heads": 16,
    "num_hidden_layers": 27,
    "patch_size": 14,
    "vision_use_head": False,
}
_DEPTH_BACKBONE = {
    "model_type": "beit",
    "hidden_size": 1024,
    "image_size": 384,
    "intermediate_size": 4096,
    "num_attention_heads": 16,
    "num_hidden_layers": 24,
    "out_features": ["stage6", "stage12", "stage18", "stage24"],
    "reshape_hidden_states": False,
    "use_relative_position_bias": True,
}
# ZoeDepth with one head for indoor and one for outdoor scenes.
_DEPTH_OF_RELEASE = {
    "backbone_config": _DEPTH_BACKBONE,
    "bin_configurations": [
        {"name": "nyu", "n_bins": 64, "min_depth": 0.001, "max_depth": 10.0},
        {"name": "kitti", "n_bins": 64, "min_depth": 0.001, "max_depth": 80.0},
    ],
    "neck_hidden_sizes": [256, 512, 1024, 1024],
    "num_patch_transformer_layers": 4,
    "patch_transformer_hidden_size": 128,
    "patch_transformer_intermediate_size": 1024,
    "patch_transformer_num_attention_heads": 4,
}
_VALUES: dict[str, Any] = {
    "model_type": "spatialvla",
    "image_token_index": 257152,
    "action_token_begin_idx": 257153,
    "spatial_token_num": 8194,
    "use_spatial_token": True,
    "use_vision_zoe": True,
    "ego3d_patch_reso": 2,
    "n_freqs": 8,
    "projection_dim": 2304,
    "text_config": {"hidden_size": 2304, "vocab_size": 265347, "tie_word_embeddings": False},
    "vision_config": _VISION,
    "vision_zoe_config": _DEPTH_OF_RELEASE,
}


def full_size_spatialvla() -> SpatialVLANetwork:
    """Return SpatialVLA-4B on the meta device."""
    return build_spatialvla(SpatialVLAConfig.from_json(_VALUES), torch.bfloat16)


# -- pictures -------------------------------------------------------------------------------------------------

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class PictureSettings:
    """The preparation of pictures.

    Attributes:
        side: Side in pixels of the square they are squeezed into.
        resampling: Number of the filter in PIL.
        scale: Factor of the bytes.
        mean: Mean of every colour; None for the released models, which normalise inside.
        deviation: Deviation of every colour; None for the released models.
    """

    side: int
    resampling: int = int(Image.Resampling.BICUBIC)
    scale: float = 1 / 255
    mean: Colour | None = None
    deviation: Colour | None = None

    @classmethod
    def of(cls, config: SpatialVLAConfig, folder: Path) -> "PictureSettings":
        """Read the settings of pictures, see `picture_values`; without any take the released models'.

        Raises:
            CheckpointError: For a setting that contradicts the model or is not known here.
        """
        stored = picture_values(folder)
        if stored is None:
            return cls(config.side)
        settings = cls._from_json(stored.values, config.side)
        if settings.side != config.side:
            raise CheckpointError(
                f"{stored.source} makes pictures of side {settings.side}; config.json expects {config.side}"
            )
        if settings.resampling not in {int(resampling) for resampling in Image.Resampling}:
            raise CheckpointError(
                f"{stored.source}: resample is {settings.resampling}, which PIL does not support"
            )
        return settings

    @classmethod
    def _from_json(cls, values: Mapping[str, Any], side: int) -> "PictureSettings":
        size = values.get("size") or {"height": side, "width": side}
        height, width = int(size.get("height", 0)), int(size.get("width", 0))
        normalises = bool(values.get("do_normalize", True))
        return cls(
            side=height if height == width and values.get("do_resize", True) else -1,
            resampling=int(values.get("resample", Image.Resampling.BICUBIC)),
            scale=float(values.get("rescale_factor", 1 / 255)) if values.get("do_rescale", True) else 1.0,
            mean=_colour(values.get("image_mean", (0.5, 0.5, 0.5))) if normalises else None,
            deviation=_colour(values.get("image_std", (0.5, 0.5, 0.5))) if normalises else None,
        )


def _colour(values: Any) -> Colour:
    red, green, blue = values
    return float(red), float(green), float(blue)


def prepare_picture(picture: NDArray[np.uint8], settings: PictureSettings) -> NDArray[np.float32]:
    """Return a picture (H, W, 3) uint8 as (3, S, S) float32; proportions are not kept.

    The values are in [0, 1] unless the settings normalise them.
    """
    square = Image.fromarray(picture).resize((settings.side, settings.side), Image.Resampling(settings.resampling))
    pixels = np.asarray(np.asarray(square, np.float64) * settings.scale, np.float32).transpose(2, 0, 1)
    if settings.mean is not None and settings.deviation is not None:
        mean, deviation = (np.array(c, np.float32)[:, None, None] for c in (settings.mean, settings.deviation))
        return np.asarray((pixels - mean) / deviation, np.float32)
    return np.ascontiguousarray(pixels)


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: its matrix (3, 3) in pixels, for pictures of `width` × `height`."""

    matrix: NDArray[np.floating[Any]]
    width: int
    height: int

    def at(self, side: int) -> NDArray[np.float32]:
        """Return the same camera's matrix (3, 3) float32 for a picture squeezed into a square of `side` pixels."""
        scaled = self.matrix.astype(np.float32)
        scaled[0] *= np.float32(side / self.width)
        scaled[1] *= np.float32(side / self.height)
        return scaled


def is_camera(matrix: NDArray[np.floating[Any]]) -> bool:
    """Whether a matrix is an invertible one of 3 × 3 numbers."""
    return matrix.shape == (3, 3) and bool(np.isfinite(matrix).all()) and np.linalg.det(matrix) != 0


def known_cameras(values: Mapping[str, Any], source: str) -> dict[str, Intrinsics]:
    """Return the cameras of the data sets that `intrinsic_config` of a `processor_config.json` names.

    Raises:
        CheckpointError: For a matrix that is not a camera's.
    """
    cameras = {}
    for key, entry in values.get("intrinsic_config", {}).items():
        matrix = np.asarray(entry["intrinsic"], np.float64)
        if not is_camera(matrix):
            raise CheckpointError(f"{source}: intrinsic_config of {key} is not an invertible 3 × 3 matrix")
        cameras[key] = Intrinsics(matrix, int(entry["width"]), int(entry["height"]))
    return cameras
