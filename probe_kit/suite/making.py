"""Construction of items, shared by drawn and converted questions."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NotRequired, TypedDict, Unpack, cast
from unicodedata import normalize

from probe_kit.hashing import sha256_json
from probe_kit.suite.categories import CATEGORIES
from probe_kit.suite.items import Item, Side
from probe_kit.suite.pictures import picture_file_name


@dataclass(frozen=True)
class Picture:
    """An encoded picture with all that an item records about it."""

    image_id: str
    png: bytes
    pixels_sha256: str

    @property
    def file_name(self) -> str:
        """Where it lies inside the suite's `items/`."""
        return picture_file_name(self.pixels_sha256)


class ItemDraft(TypedDict):
    """The fields of a question from which an item is made; see `Item`."""

    transfer_type: str
    construction: str
    instruction: str
    object_phrase: str
    object_article: str
    polarity: str
    target_concept: str
    distractor_concept: str
    pair_id: str
    rule_id: str
    curation_status: str
    license: str
    attribution: str
    redistributable: bool
    contains_real_face: bool
    source: dict[str, Any]
    gen: dict[str, Any]
    side_word: NotRequired[bool]
    wordings: NotRequired[dict[str, str]]


def make_item(
    suite: str,
    category: str,
    side: Side,
    pictures: tuple[Picture, Picture],
    content: Mapping[str, Any],
    **question: Unpack[ItemDraft],
) -> Item:
    """An item whose group is not known yet.

    suite: what its id begins with. side: where the correct one of `pictures`, left and right, lies.
    content: what makes it this item and no other; its hash is the id's end.
    """
    left, right = pictures
    composed = {name: normalize("NFC", one) if isinstance(one, str) else one for name, one in question.items()}
    return Item(
        item_id=f"{suite}-{category}-{sha256_json(content)[:10]}",
        category=category,
        domain=CATEGORIES[category].domain,
        correct_side=side,
        left_file_name=left.file_name,
        right_file_name=right.file_name,
        left_sha256=hashlib.sha256(left.png).hexdigest(),
        right_sha256=hashlib.sha256(right.png).hexdigest(),
        left_pixels_sha256=left.pixels_sha256,
        right_pixels_sha256=right.pixels_sha256,
        left_image_id=left.image_id,
        right_image_id=right.image_id,
        group_id="",
        split="eval",
        **cast("ItemDraft", composed),
    )
