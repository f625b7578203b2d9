"""SpatialVLA-4B on the meta device, to compare names and shapes with the released files."""

from typing import Any

import torch

from probe_kit.models.spatialvla.config import SpatialVLAConfig
from probe_kit.models.spatialvla.network import SpatialVLANetwork, build_spatialvla

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
_DEPTH = {
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
    "vision_zoe_config": _DEPTH,
}


def full_size_spatialvla() -> SpatialVLANetwork:
    """SpatialVLA-4B on the meta device."""
    return build_spatialvla(SpatialVLAConfig.from_json(_VALUES), torch.bfloat16)
