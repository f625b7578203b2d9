"""Suites of your own pictures: two pictures with a phrase each become two questions.

pair = PicturePair("living-world", "fox", Path("fox.jpg"), "hare", Path("hare.jpg"))
suite = suite_from_pictures("suites/mine", [pair, ...], name="mine", license="CC-BY-4.0", attribution="me")
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from probe_kit.errors import SuiteError, UsageError
from probe_kit.identity import sha256_json
from probe_kit.suite.card import new_suite
from probe_kit.suite.categories import CATEGORIES, check_categories
from probe_kit.suite.converters.emission import TRANSFER_TYPES
from probe_kit.suite.grouping import with_groups
from probe_kit.suite.items import Item, Side
from probe_kit.suite.manifest import refuse_foreign_folder, save_suite
from probe_kit.suite.pictures import encode_png, load_picture, picture_file_name, pixels_sha256
from probe_kit.suite.suite import Suite
from probe_kit.suite.validation.findings import listing
from probe_kit.suite.validation.rules import LOADING_RULES, pictures_unchanged
from probe_kit.suite.wording import instruction_for, side_words

_SMALLEST, _LARGEST = 224, 512  # pixels of a stored picture's side
_SIDES: tuple[Side, Side] = ("left", "right")


@dataclass(frozen=True)
class PicturePair:
    """Two pictures that lie side by side, and what each of them is called.

    category: a slug of `CATEGORIES`; it decides in which row of a table the questions are counted.
    phrase, other_phrase: complete "Put the cube on the …", such as `fox` or `open door`.
    picture, other_picture: files that Pillow reads; they are padded to a white square of 224 to 512 pixels.
    """

    category: str
    phrase: str
    picture: Path
    other_phrase: str
    other_picture: Path


@dataclass(frozen=True)
class _Stored:
    image_id: str
    phrase: str
    png: bytes
    pixels: str

    @property
    def file_name(self) -> str:
        return picture_file_name(self.pixels)


def suite_from_pictures(
    folder: Path | str,
    pairs: Sequence[PicturePair],
    *,
    name: str,
    version: str = "1.0.0",
    license: str,  # noqa: A002 -- as the field of an item is called
    attribution: str,
    redistributable: bool = False,
    contains_real_face: bool = False,
) -> Suite:
    """A suite in `folder` in which every pair is asked for both ways: neither pictures nor words alone tell.

    The first picture lies left and right in turn. license: an SPDX name, or whatever says what others may do with
    the pictures. Pairs that share a file share a group, and folds never separate them.
    Raises UnknownCategoryError, UsageError for no pair or a pair asked twice, and SuiteError for a picture that
    cannot be read, for questions that break a rule of the format, or if `folder` holds anything else. Nothing is
    written then.
    """
    folder = Path(folder)
    _check(pairs)
    refuse_foreign_folder(folder)
    items: list[Item] = []
    pictures: dict[str, bytes] = {}
    terms: dict[str, str | bool] = {
        "license": license,
        "attribution": attribution,
        "redistributable": redistributable,
        "contains_real_face": contains_real_face,
    }
    for number, pair in enumerate(pairs):
        shown = _stored(pair.picture, pair.phrase), _stored(pair.other_picture, pair.other_phrase)
        pictures |= {picture.file_name: picture.png for picture in shown}
        items += _twins(name, version, pair.category, shown if number % 2 == 0 else shown[::-1], terms)
    suite = new_suite(name, version, with_groups(items), {"pairs": len(pairs)})
    _refuse_broken(suite)
    stats = {category: {"pool": count, "emitted": count} for category, count in suite.card["counts"].items()}
    return save_suite(suite, pictures, stats, folder)


def _check(pairs: Sequence[PicturePair]) -> None:
    if not pairs:
        raise UsageError("no pair of pictures given; expected at least one PicturePair")
    check_categories([pair.category for pair in pairs], list(CATEGORIES))
    seen: set[frozenset[tuple[str, str]]] = set()
    for pair in pairs:
        content = frozenset({(pair.phrase, str(pair.picture)), (pair.other_phrase, str(pair.other_picture))})
        if content in seen:
            raise UsageError(f"{pair} is given twice; every pair is asked both ways by itself. Leave one out")
        seen.add(content)


def _refuse_broken(suite: Suite) -> None:
    """Every rule but those about files, which are not written yet."""
    findings = [finding for rule in LOADING_RULES if rule is not pictures_unchanged for finding in rule(suite)]
    if findings:
        raise SuiteError(
            f"these questions break the rules of the format:\n{listing(findings)}\n"
            "Change the phrases or the pictures. Nothing was written"
        )


def _stored(path: Path, phrase: str) -> _Stored:
    square = load_picture(path)
    size = min(max(square.width, _SMALLEST), _LARGEST)
    shown = square if square.width == size else square.resize((size, size), Image.Resampling.BICUBIC)
    pixels = pixels_sha256(shown)
    return _Stored(f"{path.name}-{pixels[:16]}", phrase, encode_png(shown), pixels)


def _twins(
    name: str, version: str, category: str, shown: tuple[_Stored, _Stored], terms: dict[str, str | bool]
) -> Iterator[Item]:
    pair_id = f"{name}-{category}-{sha256_json(sorted((s.phrase, s.pixels) for s in shown))[:12]}"
    for side in _SIDES:
        yield _item(name, version, category, shown, side, pair_id, terms)


def _item(
    name: str, version: str, category: str, shown: tuple[_Stored, _Stored], side: Side, pair_id: str,
    terms: dict[str, str | bool],
) -> Item:  # fmt: skip
    left, right = shown
    asked, other = (left, right) if side == "left" else (right, left)
    record = {
        "item_id": f"{pair_id}-{side}",
        "category": category,
        "domain": CATEGORIES[category].domain,
        "transfer_type": TRANSFER_TYPES[category],
        "construction": "native_pair",
        "instruction": instruction_for(asked.phrase, "the"),
        "object_phrase": asked.phrase,
        "object_article": "the",
        "polarity": "none",
        "target_concept": asked.phrase,
        "distractor_concept": other.phrase,
        "correct_side": side,
        **_of_side("left", left),
        **_of_side("right", right),
        "group_id": "",
        "pair_id": pair_id,
        "rule_id": "own-pictures",
        "curation_status": "accepted",
        "split": "eval",
        "side_word": bool(side_words(asked.phrase)),
        "source": {"benchmark": name, "version": version, "split": "eval", "source_id": pair_id, "url": ""},
        "gen": {},
        **terms,
    }
    return Item.from_json(record, Path())


def _of_side(side: Side, stored: _Stored) -> dict[str, str]:
    return {
        f"{side}_file_name": stored.file_name,
        f"{side}_sha256": hashlib.sha256(stored.png).hexdigest(),
        f"{side}_pixels_sha256": stored.pixels,
        f"{side}_image_id": stored.image_id,
    }
