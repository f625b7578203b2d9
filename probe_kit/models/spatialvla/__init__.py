"""SpatialVLA in plain torch and transformers: SigLIP, ZoeDepth, a 3-D position, Gemma-2, actions as tokens.

Names of modules and parameters are those of the released files, so that a checkpoint loads as it is.
Capture and actions are in its adapter in `probe_kit.hooks`.
"""

from probe_kit.models.spatialvla.actions import STEP_TOKENS, ActionBins, equal_mass_edges
from probe_kit.models.spatialvla.config import SpatialVLAConfig
from probe_kit.models.spatialvla.depth import Depth, depth_input, estimate_depth
from probe_kit.models.spatialvla.full_size import full_size_spatialvla
from probe_kit.models.spatialvla.network import Sight, SpatialVLANetwork, build_spatialvla
from probe_kit.models.spatialvla.pictures import Intrinsics, PictureSettings, known_cameras, prepare_picture
from probe_kit.models.spatialvla.space import PositionEmbedding3D, back_project, point_places

__all__ = [
    "STEP_TOKENS",
    "ActionBins",
    "Depth",
    "Intrinsics",
    "PictureSettings",
    "PositionEmbedding3D",
    "Sight",
    "SpatialVLAConfig",
    "SpatialVLANetwork",
    "back_project",
    "build_spatialvla",
    "depth_input",
    "equal_mass_edges",
    "estimate_depth",
    "full_size_spatialvla",
    "known_cameras",
    "point_places",
    "prepare_picture",
]
