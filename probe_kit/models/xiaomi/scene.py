"""The model's inputs: the image as its evaluation crops it, and the prompt."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit.models.qwen import IMAGE
from probe_kit.models.xiaomi.robots import Robot

CROP = 0.95
"""Share of each side that stays; the rest is cut off equally around it."""


def look(picture: NDArray[np.uint8], robot: Robot) -> NDArray[np.uint8]:
    """(height, width, 3) uint8: the middle of (H, W, 3) uint8, at the size the robot's pictures have.

    Resized with PIL's bicubic filter, cropped, and brought back to that size with its bilinear one.
    """
    size = (robot.width, robot.height)
    scaled = Image.fromarray(picture).resize(size, Image.Resampling.BICUBIC)
    width, height = (int(side * CROP) for side in size)
    column, top = (robot.width - width) // 2, (robot.height - height) // 2
    middle = scaled.crop((column, top, column + width, top + height))
    return np.array(middle.resize(size, Image.Resampling.BILINEAR))


def prompt(instruction: str, heading: str) -> str:
    """The whole text, with one image slot; the model answers with actions, so its words are given and empty."""
    return (
        "<|im_start|>user\nThe following observations are captured from multiple views.\n"
        f"# {heading}\n{IMAGE}\n"
        f"Generate robot actions for the task:\n{_sentence(instruction)} /no_cot<|im_end|>\n"
        "<|im_start|>assistant\n<cot></cot><|im_end|>\n"
    )


def _sentence(instruction: str) -> str:
    """Return the instruction with a capital and a full stop, as in training."""
    text = instruction.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")
