"""The vision tower: timm's ConvNeXt before its head, and the projector from its maps to tokens.

N pictures' crops, S side of a crop, (h, w) the map of a picture, D width of the language model.
"""

from typing import Any

import torch
from torch import Tensor, nn

from probe_kit._system.optional_dependencies import require
from probe_kit.errors import CheckpointError
from probe_kit.models.magma.config import VisionConfig
from probe_kit.models.magma.pictures import Grid, Picture


class ClipVisionModel(nn.Module):
    """Holds the trunk under the name it has in the released files."""

    def __init__(self, trunk: Any) -> None:
        super().__init__()
        self.trunk = trunk


class VisionTower(nn.Module):
    """The trunk without its head, which the forward pass never reads."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        trunk = require("timm", "magma").create_model(
            config.trunk, pretrained=False, num_classes=0, **config.overrides
        )
        self.width, self.reduction = int(trunk.num_features), int(trunk.feature_info[-1]["reduction"])
        trunk.head = nn.Identity()
        self.clip_vision_model = ClipVisionModel(trunk)
        if config.feature_width not in (None, self.width):
            raise CheckpointError(
                f"the projector reads {config.feature_width} features (mm_hidden_size), but the trunk "
                f"{config.trunk} puts out {self.width}"
            )

    @property
    def stages(self) -> list[Any]:
        """The trunk's stages, each a module from map to map."""
        return list(self.clip_vision_model.trunk.stages)

    @property
    def stem(self) -> Any:
        """The module that makes the first map."""
        return self.clip_vision_model.trunk.stem

    def forward(self, pixels: Tensor) -> Tensor:
        """(N, features, S / reduction, S / reduction) from (N, 3, S, S)."""
        trunk = self.clip_vision_model.trunk
        maps: Tensor = trunk.stages(trunk.stem(pixels))
        return maps


class Projector(nn.Module):
    """Map features to the language model's width, place by place, and the vector that ends every row of a map."""

    def __init__(self, config: VisionConfig, features: int, width: int) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Linear(features, width)]
        for _ in range(1, config.projector_layers):
            layers += [nn.GELU(), nn.Linear(width, width)]
        self.proj = nn.Sequential(*layers)
        self.row_seperator = nn.Parameter(torch.zeros(1, 1, width))  # as the released files spell it
        if config.separators:
            self.img_start_seperator = nn.Parameter(torch.zeros(1, width))
            self.img_end_seperator = nn.Parameter(torch.zeros(1, width))

    def forward(self, maps: Tensor) -> Tensor:
        """(…, D) from (…, features)."""
        projected: Tensor = self.proj(maps)
        return projected

    def tokens(self, projected: Tensor) -> Tensor:
        """(h · (w + 1), D) from (h, w, D): row by row, a separator behind each."""
        separators = self.row_seperator.expand(projected.shape[0], 1, -1)
        return torch.cat([projected, separators], dim=1).flatten(0, 1)


def stitched(crops: Tensor, grid: Grid) -> Tensor:
    """(rows · a, columns · b, C) from crops (rows · columns, a, b, C) in raster order."""
    high, wide, channels = crops.shape[1:]
    places = crops.reshape(grid.rows, grid.columns, high, wide, channels).transpose(1, 2)
    return places.reshape(grid.rows * high, grid.columns * wide, channels)


def whole_picture(picture: Picture) -> Tensor:
    """(1, 3, rows · S, columns · S): the picture that the crops were cut from."""
    return stitched(picture.crops.permute(0, 2, 3, 1), picture.grid).permute(2, 0, 1)[None]


def map_size(grid: Grid, side: int, reduction: int, strategy: str) -> tuple[int, int]:
    """(h, w) of a picture's map; crops that the reduction does not divide lose their rest one by one."""
    if strategy == "global":
        return grid.rows * side // reduction, grid.columns * side // reduction
    return grid.rows * (side // reduction), grid.columns * (side // reduction)
