"""Conversion of observations to the formats of other toolkits."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image


def to_lerobot(observation: Mapping[str, Any]) -> dict[str, Any]:
    """The observation as lerobot's policies name it, in numpy.

    `observation.images.image`: (..., 3, H, W) float32 in [0, 1]. `observation.state`: (..., 8) float32. Leading
    batch dimensions, as a vector environment adds them, stay.
    """
    image = np.asarray(observation["pixels"]["image"])
    return {
        "observation.images.image": np.moveaxis(image, -1, -3).astype(np.float32) / 255,
        "observation.state": np.asarray(observation["agent_pos"], np.float32),
    }


def to_openpi(observation: Mapping[str, Any], prompt: str, size: int = 224) -> dict[str, Any]:
    """One observation as an openpi policy server expects it.

    `observation/image`: (size, size, 3) uint8, the whole picture shrunk and padded with black to a square.
    `observation/state`: (8,) float32. `prompt`: the instruction.
    """
    return {
        "observation/image": _padded(Image.fromarray(observation["pixels"]["image"]), size),
        "observation/state": np.asarray(observation["agent_pos"], np.float32),
        "prompt": prompt,
    }


def _padded(image: Image.Image, size: int) -> Any:
    scale = size / max(image.size)
    small = image.resize((round(image.width * scale), round(image.height * scale)), Image.Resampling.BILINEAR)
    square = Image.new("RGB", (size, size))
    square.paste(small, ((size - small.width) // 2, (size - small.height) // 2))
    return np.asarray(square)
