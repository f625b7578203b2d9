"""First and last frame of an episode, at thumbnail height. Simulating processes import this, no array store."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image

HEIGHT = 120
"""Pixels; a pair of 4:3 frames is 320 wide and takes about 2 kB."""

Ends = tuple[NDArray[np.uint8], ...]
"""First and last frame, (h, w, 3) uint8 each; the first alone where nothing moved."""


def shrink(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A rendered frame (H, W, 3) uint8 at thumbnail height."""
    height, width, _ = frame.shape
    size = (round(width * HEIGHT / height), HEIGHT)
    return np.asarray(Image.fromarray(frame).resize(size, Image.Resampling.LANCZOS))
