"""The resizing of GR00T's pictures: as NVIDIA's newest code does it, or as lerobot."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib.metadata import version
from typing import Any

import cv2
import numpy as np
import torch
from lerobot.policies.groot.processor_groot import GrootN17VLMEncodeStep
from numpy.typing import NDArray
from torch import Tensor
from torchvision.transforms.v2 import functional

from probe_kit.errors import CheckpointError

NVIDIAS_VERSION = "gr00t_n1d7 of Isaac-GR00T, commit 1852a8c of 2026"
"""The newest code of NVIDIA that was read."""
_EDGE, _FRACTION = 256, 0.95
"""What NVIDIA's processor takes for fields that a file lacks."""


@dataclass
class NvidiasPictures(GrootN17VLMEncodeStep):  # type: ignore[misc]
    """lerobot's step with NVIDIA's resizing in place of its own.

    NVIDIA squashes to the target size, bilinearly, and cuts pixels out; lerobot is bicubic and cuts a fraction.
    With `use_albumentations` both bring the shortest edge to a length by area; without a length, NVIDIA squashes.
    """

    def __post_init__(self) -> None:
        """Raise CheckpointError for sizes that are missing: NVIDIA's code has no others."""
        missing = [name for name in ("image_target_size", "image_crop_size") if getattr(self, name) is None]
        needed = not self.use_albumentations or (self.shortest_image_edge is None or self.crop_fraction is None)
        if missing and needed:
            raise CheckpointError(
                f"the processor file has no {' and no '.join(missing)}, without which NVIDIA's code resizes no "
                "picture. Take the original file, or -M resize=lerobot for lerobot's default"
            )

    def _build_sample_images(self, video: Any, batch_size: int, target_device: Any) -> list[list[Tensor]]:
        """(3, H, W) uint8 per frame and camera. video: (B, T, V, H, W, 3) uint8."""
        del target_device
        pictures = np.asarray(video)
        return [
            [self.resized(np.ascontiguousarray(picture)) for frames in pictures[row] for picture in frames]
            for row in range(batch_size)
        ]

    def resized(self, picture: NDArray[np.uint8]) -> Tensor:
        """(3, H, W) uint8 of (H, W, 3)."""
        square = _letterboxed(picture) if self.letter_box_transform else picture
        if self.use_albumentations:
            return torch.from_numpy(np.ascontiguousarray(self._by_area(square))).permute(2, 0, 1)
        tensor = torch.from_numpy(square).permute(2, 0, 1)
        target, crop = list(self.image_target_size or ()), list(self.image_crop_size or ())
        cut = functional.center_crop(functional.resize(tensor, target), crop)
        resized: Tensor = functional.resize(cut, target)
        return resized

    def _by_area(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Resized, cut, and resized again."""
        target, crop = self.image_target_size or [1, 1], self.image_crop_size or [1, 1]
        fraction = crop[0] / target[0] if self.crop_fraction is None else self.crop_fraction
        first = self._one_size(picture)
        height, width = (max(1, int(side * fraction)) for side in first.shape[:2])
        top, column = (first.shape[0] - height) // 2, (first.shape[1] - width) // 2
        return self._one_size(first[top : top + height, column : column + width])

    def _one_size(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The shortest edge at its length, or squashed where there is none."""
        if self.shortest_image_edge is None:
            height, width = self.image_target_size or [1, 1]
        else:
            scale = self.shortest_image_edge / min(picture.shape[:2])
            height, width = (max(1, round(side * scale)) for side in picture.shape[:2])
        if (height, width) == picture.shape[:2]:
            return picture
        resized: NDArray[np.uint8] = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))
        return resized

    @property
    def rule(self) -> str:
        """The rule in words, for the card."""
        size = " x ".join(map(str, self.image_target_size or ()))
        if not self.use_albumentations:
            return f"squashed to {size} bilinearly, as {NVIDIAS_VERSION}; lerobot is bicubic (-M resize=lerobot)"
        if self.shortest_image_edge is None:
            return f"squashed to {size} by area, as {NVIDIAS_VERSION}; lerobot does not squash (-M resize=lerobot)"
        return f"shortest edge {self.shortest_image_edge} by area, as {NVIDIAS_VERSION}, and lerobot"


def nvidias_pictures(step: GrootN17VLMEncodeStep, settings: Mapping[str, Any] | None) -> NvidiasPictures:
    """The step with NVIDIA's resizing.

    settings: of its processor file, whose missing fields have NVIDIA's values; None in lerobot's layout.
    """
    values = {field.name: getattr(step, field.name) for field in fields(GrootN17VLMEncodeStep) if field.init}
    if settings is not None:
        values |= {name: settings.get(name) for name in ("image_target_size", "image_crop_size")}
        values["shortest_image_edge"] = settings.get("shortest_image_edge", _EDGE)
        values["crop_fraction"] = settings.get("crop_fraction", _FRACTION)
    return NvidiasPictures(**values)


def lerobots_rule(step: GrootN17VLMEncodeStep) -> str:
    """The resizing of lerobot's own step in words, for the card."""
    kind = "by area" if step.use_albumentations else "squashed, bicubic"
    return f"{kind}, as lerobot {version('lerobot')}; NVIDIA's code differs (-M resize=nvidia)"


def _letterboxed(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(side, side, 3) of (H, W, 3), black bars on both ends."""
    height, width = picture.shape[:2]
    side = max(height, width)
    rows, columns = side - height, side - width
    return np.pad(picture, ((rows // 2, rows - rows // 2), (columns // 2, columns - columns // 2), (0, 0)))
