"""Animated recording of an episode."""

from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from probe_kit.env.simulation.camera import Picture


def save_gif(path: Path, pictures: Sequence[Picture], fps: float = 5.0) -> None:
    """Write pictures (H, W, 3) uint8 as an endless GIF; collect them with `env.render()` after each action.

    Raises ValueError if there are none.
    """
    if not pictures:
        raise ValueError(f"{path}: no pictures to write; call `env.render()` at least once.")
    first, *rest = (Image.fromarray(picture) for picture in pictures)
    # A GIF counts in hundredths of a second, and many players slow down anything below two of them.
    duration = max(20, round(100 / fps) * 10)
    first.save(path, save_all=True, append_images=rest, duration=duration, loop=0)
