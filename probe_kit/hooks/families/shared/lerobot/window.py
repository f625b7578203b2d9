"""The image region that a policy sees: lerobot's crop-and-resize step, read from a checkpoint."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from lerobot.policies.common.vla_utils import resize_with_pad_torch
from lerobot.policies.smolvla.modeling_smolvla import resize_with_pad
from numpy.typing import NDArray
from torch import Tensor
from torchvision.transforms.v2 import functional

from probe_kit.errors import CheckpointError, ObservationError
from probe_kit.hooks.families.shared.lerobot.pipelines import CROP, PREPROCESSOR, step_fields


@dataclass(frozen=True)
class PictureWindow:
    """Crop, then resize (bilinear, antialiased) as lerobot's `ImageCropResizeProcessorStep` does.

    Attributes:
        crop: Top, left, height, width in pixels of the camera; None for the whole picture.
        size: (height, width) after; None leaves the size.
        camera: (height, width) of the pictures that `crop` was chosen on. Others are brought to it first, with
            their proportions kept by padding, as pi0 brings pictures to its own resolution. None for any.
    """

    crop: tuple[int, int, int, int] | None = None
    size: tuple[int, int] | None = None
    camera: tuple[int, int] | None = None

    def __call__(self, pictures: Tensor) -> Tensor:
        """Return the region of pictures (B, 3, H, W) in [0, 1] that the policy looks at.

        Raises:
            ObservationError: If the crop lies outside.
        """
        if self.crop is not None:
            if self.camera is not None and self.camera != tuple(pictures.shape[-2:]):
                pictures = resize_with_pad_torch(pictures, *self.camera)
            top, column, height, width = self.crop
            if top + height > pictures.shape[-2] or column + width > pictures.shape[-1]:
                raise ObservationError(
                    f"the picture is {pictures.shape[-1]} x {pictures.shape[-2]} pixels; this checkpoint looks at "
                    f"columns {column} to {column + width} and rows {top} to {top + height}"
                )
            pictures = functional.crop(pictures, top, column, height, width)
        if self.size is not None:
            pictures = functional.resize(pictures, list(self.size)).clamp(0.0, 1.0)
        return pictures


def read_window(folder: Path, camera: str, size: tuple[int, int] | None = None) -> PictureWindow:
    """The window of one camera; the whole picture if the checkpoint names none.

    Args:
        folder: The folder of the checkpoint.
        camera: Name of the feature, `observation.images.<name>`.
        size: (height, width) of that camera, as the checkpoint's configuration declares it.

    Raises:
        CheckpointError: If the step holds something else than lerobot writes.
    """
    fields = step_fields(folder).get(CROP)
    if fields is None:
        return PictureWindow()
    crop, after = (fields.get("crop_params_dict") or {}).get(camera), fields.get("resize_size")
    try:
        return PictureWindow(_crop(*crop) if crop else None, _size(*after) if after else None, size)
    except TypeError as error:
        raise CheckpointError(f"{folder / PREPROCESSOR}.json: {CROP} cannot be read: {error}") from error


def squash(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize (H, W, 3) uint8 to `size` (height, width), proportions given up.

    The filter is that of INT-ACT's client.
    """
    height, width = size
    resized: NDArray[np.uint8] = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_LANCZOS4))
    return resized


def padded_top_left(pictures: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize (B, 3, H, W) in [0, 1] to `size`, proportions kept, black on the left and top: lerobot until 0.3."""
    height, width = size
    return torch.as_tensor(resize_with_pad(pictures, width, height, pad_value=0)).clamp(0.0, 1.0)


def _crop(top: int, column: int, height: int, width: int) -> tuple[int, int, int, int]:
    return int(top), int(column), int(height), int(width)


def _size(height: int, width: int) -> tuple[int, int]:
    return int(height), int(width)
