"""Items from a user's files: the stored picture, and the record of the question."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from unicodedata import normalize

from PIL import Image

from probe_kit.errors import SuiteError
from probe_kit.suite.categories import category_of
from probe_kit.suite.converters.emission import TRANSFER_TYPES
from probe_kit.suite.items import Item, Side
from probe_kit.suite.pictures import encode_png, load_picture, picture_file_name, pixels_sha256
from probe_kit.suite.suite import Suite
from probe_kit.suite.validation.findings import listing
from probe_kit.suite.validation.rules import LOADING_RULES, pictures_unchanged
from probe_kit.suite.wording import side_words

_SMALLEST, _LARGEST = 224, 512  # pixels of a stored picture's side


@dataclass(frozen=True)
class Terms:
    """What others may do with the pictures; the names are those of an item's fields."""

    license: str
    attribution: str
    redistributable: bool = False
    contains_real_face: bool = False


@dataclass(frozen=True)
class Shown:
    """A picture as a suite stores it, and what it is called."""

    image_id: str
    phrase: str
    png: bytes
    pixels: str

    @property
    def file_name(self) -> str:
        """Where it lies in the suite's folder."""
        return picture_file_name(self.pixels)


def shown(path: Path, phrase: str) -> Shown:
    """The picture in `path` on a white square of 224 to 512 pixels.

    Raises SuiteError for a file that is missing or that Pillow cannot decode.
    """
    square = load_picture(path)
    size = min(max(square.width, _SMALLEST), _LARGEST)
    stored = square if square.width == size else square.resize((size, size), Image.Resampling.BICUBIC)
    pixels = pixels_sha256(stored)
    return Shown(f"{path.name}-{pixels[:16]}", phrase, encode_png(stored), pixels)


@dataclass(frozen=True)
class Origin:
    """Suite name, version and category of an item, the pair that it is part of, and the rule that made it."""

    name: str
    version: str
    category: str
    pair_id: str
    rule: str


def own_item(
    item_id: str,
    origin: Origin,
    instruction: str,
    article: str,
    pictures: tuple[Shown, Shown],
    correct: Side,
    terms: Terms,
) -> Item:
    """One question over the left and the right picture; `article` as in `instruction_for`."""
    left, right = pictures
    asked, other = (left, right) if correct == "left" else (right, left)
    record = {
        "item_id": item_id,
        "category": origin.category,
        "domain": category_of(origin.category).domain,
        "transfer_type": TRANSFER_TYPES.get(origin.category, "near"),
        "construction": "native_pair",
        "instruction": instruction,
        "object_phrase": asked.phrase,
        "object_article": article,
        "polarity": "none",
        "target_concept": asked.phrase,
        "distractor_concept": other.phrase,
        "correct_side": correct,
        **_of_side("left", left),
        **_of_side("right", right),
        "group_id": "",
        "pair_id": origin.pair_id,
        "rule_id": origin.rule,
        "curation_status": "accepted",
        "split": "eval",
        "side_word": bool(side_words(asked.phrase)),
        "source": _source(origin),
        "gen": {},
        **vars(terms),
    }
    composed = {name: normalize("NFC", one) if isinstance(one, str) else one for name, one in record.items()}
    return Item.from_json(composed, Path())


def _source(origin: Origin) -> Mapping[str, str]:
    return {
        "benchmark": origin.name,
        "version": origin.version,
        "split": "eval",
        "source_id": origin.pair_id,
        "url": "",
    }


def _of_side(side: Side, picture: Shown) -> dict[str, str]:
    return {
        f"{side}_file_name": picture.file_name,
        f"{side}_sha256": hashlib.sha256(picture.png).hexdigest(),
        f"{side}_pixels_sha256": picture.pixels,
        f"{side}_image_id": picture.image_id,
    }


def check_broken(suite: Suite, places: Mapping[str, str] = MappingProxyType({})) -> None:
    """Raise SuiteError for a broken rule of the format; rules about files are left out, none is written yet.

    places: by item, where a user wrote it.
    """
    findings = [
        replace(finding, where=places.get(finding.where.removeprefix("item "), finding.where))
        for rule in LOADING_RULES
        if rule is not pictures_unchanged
        for finding in rule(suite)
    ]
    if findings:
        raise SuiteError(
            f"these questions break the rules of the format:\n{listing(findings)}\n"
            "Change the phrases or the pictures. Nothing was written"
        )


def statistics_of(suite: Suite) -> dict[str, dict[str, int]]:
    """Per category, how many items there were and how many were kept: all of them."""
    return {category: {"pool": count, "emitted": count} for category, count in suite.card["counts"].items()}
