"""Types that every folder means the same by."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
"""An array of float64, of any number of dimensions; the text beside it says which."""
PictureArray = NDArray[np.uint8]
"""Pictures (…, H, W, 3) in RGB."""
Progress = Callable[[int, int, str], None]
"""A function that is called with (items done, items in all, name of the item just done)."""
