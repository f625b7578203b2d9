"""What the model sees of a picture of the camera's size; the same crop and resize as at inference."""

import numpy as np
import torch
from numpy.typing import NDArray
from torchvision.transforms.v2 import functional

from probe_kit.hooks.families.embedded import IMAGE_SIDE, LOOKED_AT


def model_view(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(480, 640, 3) or (480, 640) uint8 to (96, 96, 3) or (96, 96) uint8."""
    channels = torch.from_numpy(np.ascontiguousarray(np.atleast_3d(picture))).permute(2, 0, 1)
    resized = functional.resize(functional.crop(channels[None].float(), *LOOKED_AT), [IMAGE_SIDE, IMAGE_SIDE])
    small = resized[0].clamp(0, 255).permute(1, 2, 0).round().to(torch.uint8)
    return small.numpy().reshape(*small.shape[:2], *picture.shape[2:])
