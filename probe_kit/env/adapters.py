"""Conversion of observations to the formats of other toolkits, and of pictures to a GIF."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from probe_kit.env.simulation.camera import Picture


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


def save_gif(path: Path, pictures: Sequence[Picture], fps: float = 5.0) -> None:
    """Write pictures (H, W, 3) uint8 as an endless GIF; collect them with `env.render()` after each action.

    Raises ValueError if there are none.
    """
    if not pictures:
        raise ValueError(f"{path}: no pictures to write; call `env.render()` at least once.")
    first, *later = (Image.fromarray(picture) for picture in pictures)
    # A GIF counts in hundredths of a second, and many players slow down anything below two of them.
    duration = max(20, round(100 / fps) * 10)
    first.save(path, save_all=True, append_images=later, duration=duration, loop=0)
