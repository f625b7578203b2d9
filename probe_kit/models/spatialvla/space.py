"""3-D positions: a depth map becomes points in the camera frame, and the points of a patch become one vector.

B pictures, P patches, R points per patch and direction.
"""

import torch
from torch import Tensor, nn

# The box the code is made for: two metres to each side, four metres ahead of the camera.
_CENTRE, _HALF = (0.0, 0.0, 2.0), 2.0


def point_places(side: int, patch: int, points: int) -> Tensor:
    """(3, N) float32 pixel places u, v and 1 of the middles of a patch's `points`² parts, row by row."""
    step = patch // points
    middles = torch.arange(0, side, step) + patch / points / 2
    v, u = torch.meshgrid(middles, middles, indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)]).flatten(1).float()


def back_project(metres: Tensor, intrinsics: Tensor, patch: int, points: int) -> Tensor:
    """(B, P, 3R²) metres in the camera's frame: per patch, x, y, z of its points, row by row.

    metres: (B, 1, S, S) depth. intrinsics: (3, 3) or (B, 3, 3) for a picture of side S.
    """
    side = metres.shape[-1]
    along = side // patch
    places = point_places(side, patch, points).to(metres.device)
    depth = nn.functional.interpolate(metres, size=(along * points,) * 2, mode="area").flatten(2)
    cloud = (torch.linalg.inv(intrinsics.float()) @ places) * depth
    grouped: Tensor = cloud.reshape(-1, 3, along, points, along, points).permute(0, 2, 4, 3, 5, 1)
    return grouped.reshape(len(metres), along * along, -1)


class PositionEmbedding3D(nn.Module):
    """Points as sines and cosines of rising frequency, through two layers, to the width of the vision tower."""

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
        """(B, P, C · (2F + 1)) from coordinates (B, P, C): of each its value, F sines, F cosines."""
        centre = torch.tensor(_CENTRE, device=points.device).repeat(points.shape[-1] // 3)
        placed = ((points - centre) / _HALF).unsqueeze(-1)
        angles = placed * 2.0 ** torch.arange(self.frequencies, device=points.device)
        return torch.cat([placed, angles.sin(), angles.cos()], dim=-1).flatten(2)

    def forward(self, points: Tensor) -> Tensor:
        """(B, P, width) in the dtype of the weights from (B, P, C) float32 metres."""
        dtype = next(self.parameters()).dtype
        embedded: Tensor = self.position_embedding_head(self.code(points).to(dtype))
        return embedded
