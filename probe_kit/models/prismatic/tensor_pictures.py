"""Images resized as bfloat16 tensors, as in Act2Answer's evaluation of OpenVLA."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchvision.transforms.v2 import InterpolationMode, functional

from probe_kit.errors import CheckpointError
from probe_kit.models.prismatic.pictures import PictureSettings

_MODES = {"bicubic": InterpolationMode.BICUBIC, "bilinear": InterpolationMode.BILINEAR}


def prepare_tensor(picture: NDArray[np.uint8], settings: PictureSettings) -> NDArray[np.float32]:
    """(3 per tower, S, S) float32 from (H, W, 3) uint8: bfloat16 up to the end, antialiased, normalised there.

    Raises CheckpointError for a checkpoint that does not squeeze its pictures.
    """
    if settings.strategy != "resize-naive":
        raise CheckpointError(
            f"this checkpoint prepares pictures by {settings.strategy!r}; -M resize=tensor is that of checkpoints "
            "with resize-naive. Leave it out"
        )
    pixels = torch.from_numpy(picture.copy()).permute(2, 0, 1).to(torch.bfloat16) / 255
    towers = zip(settings.sides, settings.means, settings.deviations, settings.resampling, strict=True)
    rows: list[Tensor] = []
    for side, mean, deviation, resampling in towers:
        resized = functional.resize(pixels, [side, side], _MODES[resampling], antialias=True)
        centre, spread = (
            torch.tensor(values, dtype=torch.bfloat16)[:, None, None] for values in (mean, deviation)
        )
        rows.append((resized - centre) / spread)
    prepared: NDArray[np.float32] = torch.cat(rows).float().numpy()
    return prepared
