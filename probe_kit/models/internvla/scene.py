"""The model's inputs: the resized image, DINOv2's copy of it, and the prompt around the instruction."""

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from probe_kit.models.qwen import IMAGE

SIDE = 224
"""Of the picture that the released evaluation sends."""
_SLOT = "{instruction}"
# ImageNet's.
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def look(picture: NDArray[np.uint8], size: tuple[int, int] | None) -> NDArray[np.uint8]:
    """(height, width, 3) uint8 of (H, W, 3) uint8: squeezed to a square as the evaluation does it, by area.

    size: (width, height) the checkpoint then resizes to itself, with PIL's default filter; None for none.
    """
    squeezed = cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    if size is None or size == (SIDE, SIDE):
        return np.asarray(squeezed, np.uint8)
    return np.array(Image.fromarray(squeezed).resize(size, Image.Resampling.BICUBIC))


def dino_pixels(picture: NDArray[np.uint8], side: int) -> Tensor:
    """(3, h, w) float32 of (H, W, 3) uint8: the shorter side brought to `side`, colours normalised."""
    image = Image.fromarray(picture)
    width, height = image.size
    shorter = min(width, height)
    size = (int(side * width / shorter), int(side * height / shorter))
    if image.size != size:
        image = image.resize(size, Image.Resampling.BILINEAR)
    pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1).float() / 255
    mean, deviation = (torch.tensor(colour)[:, None, None] for colour in (_MEAN, _DEVIATION))
    return (pixels - mean) / deviation


def prompt(instruction: str, cot: str | None) -> str:
    """The whole text, with one image slot.

    cot: the text around the instruction, with {instruction} in it; None for the instruction alone.
    """
    text = instruction.lower() if cot is None else cot.replace(_SLOT, instruction.lower())
    return (
        "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n"
        f"<|im_start|>user\n{IMAGE}{text}<|im_end|>\n<|im_start|>assistant\n"
    )
