"""The maker of pictures and items, for drawn and converted questions and for those of a user."""

import hashlib
from dataclasses import dataclass
from typing import Any
from unicodedata import normalize

from PIL import Image

from probe_kit.suite.categories import category_of
from probe_kit.suite.items import Item, Side
from probe_kit.suite.pictures import encode_png, letterboxed, picture_file_name, pixels_sha256

_TRANSFER_TYPES = {
    **dict.fromkeys(("shape", "symmetry", "counting", "time", "celebrity"), "moderate"),
    "living-world": "heavy",
}
"""Of the paper's categories; `near` for all others."""
_LARGEST, _SMALLEST = 512, 224  # pixels of a stored picture's side


@dataclass(frozen=True)
class Picture:
    """An encoded picture with all that an item records about it.

    original_pixels: hash of the pixels that it was made from. operation: what was done to them before.
    """

    image_id: str
    png: bytes
    pixels_sha256: str
    original_pixels: str = ""
    operation: str = "none"

    @property
    def file_name(self) -> str:
        """The file's name inside the suite's `items/`."""
        return picture_file_name(self.pixels_sha256)


def picture_of(image_id: str, image: Image.Image) -> Picture:
    """The picture as it is."""
    return Picture(image_id, encode_png(image), pixels_sha256(image))


def squared_picture(image_id: str, image: Image.Image, operation: str = "none") -> Picture:
    """The picture on a white square of 224 to 512 pixels. operation: what was done to it before."""
    square = letterboxed(image)
    size = min(max(square.width, _SMALLEST), _LARGEST)
    stored = square if square.width == size else square.resize((size, size), Image.Resampling.BICUBIC)
    return Picture(image_id, encode_png(stored), pixels_sha256(stored), pixels_sha256(image), operation)


def make_item(item_id: str, category: str, side: Side, pictures: tuple[Picture, Picture], **fields: Any) -> Item:
    """An item whose group is not known yet.

    side: where the correct one of `pictures`, left and right, lies. fields: all others of an `Item` that are not
    those of most items. Texts are composed (Unicode's form NFC).
    """
    left, right = pictures
    record = {
        "item_id": item_id,
        "category": category,
        "domain": category_of(category).domain,
        "transfer_type": _TRANSFER_TYPES.get(category, "near"),
        "polarity": "none",
        "correct_side": side,
        "left_file_name": left.file_name,
        "right_file_name": right.file_name,
        "left_sha256": hashlib.sha256(left.png).hexdigest(),
        "right_sha256": hashlib.sha256(right.png).hexdigest(),
        "left_pixels_sha256": left.pixels_sha256,
        "right_pixels_sha256": right.pixels_sha256,
        "left_image_id": left.image_id,
        "right_image_id": right.image_id,
        "group_id": "",
        "split": "eval",
        "curation_status": "rules-only",
        "gen": {},
        **fields,
    }
    composed: dict[str, Any] = {
        name: normalize("NFC", value) if isinstance(value, str) else value for name, value in record.items()
    }
    return Item(**composed)
