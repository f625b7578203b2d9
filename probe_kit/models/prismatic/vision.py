"""The vision towers: timm's ViTs, read at their second-to-last block."""

from typing import Any

import torch
from torch import Tensor, nn

from probe_kit._system.optional_dependencies import require
from probe_kit.models.prismatic.config import TowerConfig


class LayerScale(nn.Module):
    """timm's layer scale under the name the released files have: `scale_factor` instead of `gamma`."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale_factor = nn.Parameter(torch.ones(width))

    def forward(self, features: Tensor) -> Tensor:
        """(…, width), scaled per feature."""
        return features * self.scale_factor


class VisionBackbone(nn.Module):
    """One tower, or two whose features stand side by side."""

    def __init__(self, towers: tuple[TowerConfig, ...]) -> None:
        super().__init__()
        self.featurizer = _tower(towers[0])
        if len(towers) == 2:
            self.fused_featurizer = _tower(towers[1])

    @property
    def towers(self) -> list[Any]:
        """The timm models in the order of their channels."""
        second = getattr(self, "fused_featurizer", None)
        return [self.featurizer] if second is None else [self.featurizer, second]

    @property
    def width(self) -> int:
        """Features per patch."""
        return sum(int(tower.embed_dim) for tower in self.towers)

    def forward(self, pixel_values: Tensor) -> Tensor:
        """(B, P, width) patch features from (B, 3 per tower, S, S); neither class nor register tokens, no norm."""
        parts = torch.split(pixel_values, 3, dim=1)
        features = [
            tower.get_intermediate_layers(part, n=[len(tower.blocks) - 2])[0]
            for tower, part in zip(self.towers, parts, strict=True)
        ]
        return torch.cat(features, dim=2)


def _tower(config: TowerConfig) -> Any:
    timm = require("timm", "openvla")
    tower = timm.create_model(
        config.timm_id,
        pretrained=False,
        num_classes=0,
        img_size=config.image_size,
        act_layer=config.act_layer,
        **config.overrides,
    )
    for block in tower.blocks:
        for name in ("ls1", "ls2"):
            if not isinstance(getattr(block, name), nn.Identity):
                setattr(block, name, LayerScale(int(tower.embed_dim)))
    return tower
