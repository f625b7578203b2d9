"""What the policy sees of a camera picture; the same crop and resize as at inference."""

import numpy as np
import torch
from numpy.typing import NDArray

from probe_kit.hooks.families.lerobot_window import PictureWindow
from probe_kit.models.pi0_tiny import IMAGE_SIDE, LOOKED_AT


def seen_by_policy(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(480, 640, 3) or (480, 640) uint8 to (96, 96, 3) or (96, 96) uint8."""
    channels = torch.from_numpy(np.ascontiguousarray(np.atleast_3d(picture))).permute(2, 0, 1)
    seen = WINDOW_OF_POLICY(channels[None].float() / 255)[0].permute(1, 2, 0)
    return (seen * 255).round().to(torch.uint8).numpy().reshape(*seen.shape[:2], *picture.shape[2:])


WINDOW_OF_POLICY = PictureWindow(LOOKED_AT, (IMAGE_SIDE, IMAGE_SIDE))
