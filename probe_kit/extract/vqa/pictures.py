"""The two pictures of an episode side by side on grey, without perspective, arm or cube."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from probe_kit.suite import Episode, load_picture

GREY = (128, 128, 128)
MARGIN = 0.05
"""Of the width, at every edge and between the pictures."""


def side_by_side(episode: Episode, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 of `shape`: left and right picture of the episode, as large as fits and equally large.

    Raises SuiteError for a picture that is missing or damaged.
    """
    height, width = shape
    gap = round(MARGIN * width)
    side = min((width - 3 * gap) // 2, height - 2 * gap)
    canvas = Image.new("RGB", (width, height), GREY)
    for number, picture in enumerate((episode.picture("left"), episode.picture("right"))):
        drawn = load_picture(picture).resize((side, side), Image.Resampling.LANCZOS)
        middle = width // 4 if number == 0 else width - width // 4
        canvas.paste(drawn, (middle - side // 2, (height - side) // 2))
    return np.asarray(canvas)
