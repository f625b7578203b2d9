"""Suites from a user's pictures: two pictures with a phrase each become two questions.

pair = PicturePair("living-world", "fox", Path("fox.jpg"), "hare", Path("hare.jpg"))
suite = suite_from_pictures("suites/mine", [pair, ...], name="mine", license="CC-BY-4.0", attribution="me")
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from probe_kit.errors import UsageError
from probe_kit.hashing import sha256_json
from probe_kit.suite.card import new_suite
from probe_kit.suite.categories import check_slug
from probe_kit.suite.custom.own_items import Origin, Shown, Terms, check_broken, own_item, shown, statistics_of
from probe_kit.suite.grouping import with_groups
from probe_kit.suite.items import Item, Side
from probe_kit.suite.manifest import check_foreign_folder, save_suite
from probe_kit.suite.suite import Suite
from probe_kit.suite.wording import instruction_for

_SIDES: tuple[Side, Side] = ("left", "right")


@dataclass(frozen=True)
class PicturePair:
    """Two pictures that lie side by side, and what each of them is called.

    category: one of the paper's or any name of your own, such as `ripe-fruit`; the row of a table in which the
    questions are counted.
    phrase, other_phrase: complete "Put the cube on the …", such as `fox` or `open door`.
    picture, other_picture: files that Pillow reads; they are padded to a white square of 224 to 512 pixels.
    """

    category: str
    phrase: str
    picture: Path
    other_phrase: str
    other_picture: Path


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
    Raises UsageError for no pair, a pair asked twice or an impossible category name, and SuiteError for a picture
    that cannot be read, for questions that break a rule of the format, or if `folder` holds anything else. Nothing
    is written then.
    """
    folder = Path(folder)
    _check(pairs)
    check_foreign_folder(folder)
    items: list[Item] = []
    pictures: dict[str, bytes] = {}
    terms = Terms(license, attribution, redistributable, contains_real_face)
    for number, pair in enumerate(pairs):
        both = shown(pair.picture, pair.phrase), shown(pair.other_picture, pair.other_phrase)
        pictures |= {picture.file_name: picture.png for picture in both}
        items += _twins(name, version, pair.category, both if number % 2 == 0 else both[::-1], terms)
    suite = new_suite(name, version, with_groups(items), {"pairs": len(pairs)})
    check_broken(suite)
    return save_suite(suite, pictures, statistics_of(suite), folder)


def _check(pairs: Sequence[PicturePair]) -> None:
    if not pairs:
        raise UsageError("no pair of pictures given; expected at least one PicturePair")
    for category in {pair.category for pair in pairs}:
        check_slug(category)
    seen: set[frozenset[tuple[str, str]]] = set()
    for pair in pairs:
        content = frozenset({(pair.phrase, str(pair.picture)), (pair.other_phrase, str(pair.other_picture))})
        if content in seen:
            raise UsageError(f"{pair} is given twice; every pair is asked both ways by itself. Leave one out")
        seen.add(content)


def _twins(name: str, version: str, category: str, pictures: tuple[Shown, Shown], terms: Terms) -> Iterator[Item]:
    pair_id = f"{name}-{category}-{sha256_json(sorted((p.phrase, p.pixels) for p in pictures))[:12]}"
    origin = Origin(name, version, category, pair_id, "own-pictures")
    for side, asked in zip(_SIDES, pictures, strict=True):
        instruction = instruction_for(asked.phrase, "the")
        yield own_item(f"{pair_id}-{side}", origin, instruction, "the", pictures, side, terms)
