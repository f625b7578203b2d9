"""Small copies of an episode's frames, kept for people. Simulating processes import this, no array store."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image

HEIGHT = 120
"""The height in pixels where first and last frame are kept.

A pair of 4:3 frames is 320 wide and takes about 2 kB.
"""
FILM_HEIGHT = 144
"""The height in pixels where every frame is kept.

One frame takes about 4 kB. The time to draw one grows with its pixels.
"""

SmallFrames = tuple[NDArray[np.uint8], ...]
"""The frames (h, w, 3) uint8: the first and last one, the first alone where nothing moved, or every one."""


def shrink(*pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return pictures (H, W, 3) uint8 of one moment side by side at `HEIGHT`, each as wide as the first one."""
    height, width, _ = pictures[0].shape
    size = (round(width * HEIGHT / height), HEIGHT)
    resized = [Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS) for picture in pictures]
    return np.hstack([np.asarray(picture) for picture in resized])
