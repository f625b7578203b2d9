"""Features by which near-duplicate pictures are found."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image

from probe_kit.suite.pictures import difference_hash, pixels_sha256

NEAR_DUPLICATE_BITS = 4
"""Of the 64 of a difference hash."""
_BLOCKS = 8
_SAME_COLOUR = 24.0  # levels, mean over channels, in every one of 8 × 8 blocks


@dataclass(frozen=True)
class Look:
    """Pixels, brightness and, as one shape comes in several colours, colour.

    colours: (8, 8, 3) float64, the mean colour of every block, 0 to 255.
    """

    pixels_sha256: str
    brightness: int
    colours: npt.NDArray[np.float64]

    def same_as(self, other: "Look") -> bool:
        """Whether two pictures are, or nearly are, the same."""
        if self.pixels_sha256 == other.pixels_sha256:
            return True
        if (self.brightness ^ other.brightness).bit_count() > NEAR_DUPLICATE_BITS:
            return False
        return float(np.abs(self.colours - other.colours).mean(axis=2).max()) < _SAME_COLOUR


def look_of(image: Image.Image) -> Look:
    """The look of one picture."""
    blocks = image.convert("RGB").resize((_BLOCKS, _BLOCKS), Image.Resampling.BOX)
    return Look(pixels_sha256(image), difference_hash(image), np.asarray(blocks, np.float64))
