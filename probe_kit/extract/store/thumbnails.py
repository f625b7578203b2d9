"""First and last frame of an episode, small enough to keep them for every episode of a run.

They illustrate and are derived: no commit names them, no number depends on them, and they are safe to delete.
"""

from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit.extract.store.layout import FRAMES
from probe_kit.extract.store.locate import locate
from probe_kit.extract.store.location import Location

HEIGHT = 120
"""Pixels; a pair of 4:3 frames is 320 wide and takes about 2 kB."""
QUALITY = 85

Ends = tuple[NDArray[np.uint8], ...]
"""First and last frame, (h, w, 3) uint8 each; the first alone where nothing moved."""


def shrink(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A rendered frame (H, W, 3) uint8 at thumbnail height."""
    height, width, _ = frame.shape
    size = (round(width * HEIGHT / height), HEIGHT)
    return np.asarray(Image.fromarray(frame).resize(size, Image.Resampling.LANCZOS))


def write_thumbnail(run: Path | Location, number: int, ends: Ends) -> None:
    """Store the frames of episode `number` side by side as one WebP, whole or not at all."""
    encoded = BytesIO()
    Image.fromarray(np.hstack(ends)).save(encoded, "WEBP", quality=QUALITY, method=4)
    locate(run).write(thumbnail_key(number), encoded.getvalue())


def read_thumbnail(run: Path | Location, number: int) -> bytes | None:
    """The WebP of episode `number`, first frame left and last frame right; None if the run keeps none."""
    try:
        return locate(run).read(thumbnail_key(number))
    except FileNotFoundError:
        return None


def thumbnail_key(number: int) -> str:
    """Where the thumbnail of episode `number` lies."""
    return f"{FRAMES}/{number:08d}.webp"
