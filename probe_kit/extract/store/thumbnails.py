"""First and last frame of an episode, compressed to about 2 kB each.

They illustrate: no number depends on them. The commit of their episode names them with their hash, because who
looks at a report believes what it shows. All of them may be deleted, not single ones.
"""

from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from probe_kit.errors import RunDamagedError
from probe_kit.extract.run_layout import FRAMES
from probe_kit.extract.store.format.commits import read_pictures, redo_picture
from probe_kit.extract.store.frame_ends import Ends
from probe_kit.extract.store.locations.locate import locate
from probe_kit.extract.store.locations.location import Location

QUALITY = 85


def as_thumbnail(ends: Ends) -> bytes:
    """The frames side by side as one WebP."""
    encoded = BytesIO()
    Image.fromarray(np.hstack(ends)).save(encoded, "WEBP", quality=QUALITY, method=4)
    return encoded.getvalue()


def read_thumbnail(run: Path | Location, number: int) -> bytes | None:
    """The WebP of episode `number`, first frame left and last frame right; None if the run keeps none.

    Raises RunDamagedError if it is not the one that was stored when the episode was committed, or is lost alone.
    Pictures of former versions, and those beside arrays that are no run, are bound to nothing.
    """
    location, key = locate(run), thumbnail_key(number)
    promised = read_pictures(location, number)
    if promised is not None and key not in promised:
        return None
    try:
        content = location.read(key)
    except FileNotFoundError:
        if promised is None or not location.keys(FRAMES):
            return None
        raise RunDamagedError(f"{location}/{key} is missing. {redo_picture(number)}") from None
    if promised is not None and (problem := promised[key].problem(content)):
        raise RunDamagedError(f"{location}/{key} {problem}. {redo_picture(number)}")
    return content


def thumbnail_key(number: int) -> str:
    """Where the thumbnail of episode `number` lies."""
    return f"{FRAMES}/{number:08d}.webp"
