"""Metric depth maps from ZoeDepth, at the resolution of the image.

B pictures of side S.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

# The original fixes both in its code; no file of a checkpoint names them.
MARGIN = 31
"""Pixels of mirrored picture on every side, so that the map has no border effects."""
DEPTH_SIDE = 384
"""Side of what ZoeDepth sees, in pixels."""


@dataclass(frozen=True)
class Depth:
    """The depth of pictures by ZoeDepth, float32.

    metres: (B, 1, S, S). raw: (B, H, W) as predicted, with the margin. domains: (B, 2) logits for indoor and
    outdoor scenes, which choose the head that measures; None for a ZoeDepth of one head.
    """

    metres: Tensor
    raw: Tensor
    domains: Tensor | None


def depth_input(pictures: Tensor) -> Tensor:
    """(B, 3, 384, 384) in [-1, 1] from (B, 3, S, S) in [0, 1]."""
    padded = nn.functional.pad(pictures, (MARGIN, MARGIN, MARGIN, MARGIN), mode="reflect")
    resized = nn.functional.interpolate(padded, size=(DEPTH_SIDE, DEPTH_SIDE), mode="bicubic", align_corners=True)
    return (resized - 0.5) / 0.5


def estimate_depth(network: Any, pictures: Tensor, vote: bool = False) -> Depth:
    """Depth of (B, 3, S, S) float32 pictures in [0, 1]; `network` is a `ZoeDepthForDepthEstimation`.

    vote: let the batch choose one head for all its pictures, as the original does. Without it every picture has
    the head it would have alone, so that a row does not depend on the others in its batch.
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
