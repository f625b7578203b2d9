"""A suite: its items, its metadata card (the content of `suite.json`), and selections from it."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np
import PIL
from PIL import Image, features

from probe_kit._system.counting import plural
from probe_kit.errors import UsageError
from probe_kit.hashing import canonical_json, sha256_text
from probe_kit.suite.categories import CATEGORIES, category_of, check_categories, in_order
from probe_kit.suite.items import LAYOUTS, SCHEMA_VERSION, Episode, Item, Side
from probe_kit.suite.pictures import encode_png, letterbox, picture_file_name, pixels_sha256
from probe_kit.version import __version__


def questions_sha256(items: Iterable[Item]) -> str:
    """Return the hex sha256 of what the items ask and show, and of their groups, in any order.

    Seeds are made of it.
    """
    return _sha256_of_lines(item.question for item in _by_id(items))


def _by_id(items: Iterable[Item]) -> list[Item]:
    return sorted(items, key=lambda item: item.item_id)


def _sha256_of_lines(records: Iterable[dict[str, str]]) -> str:
    return sha256_text("\n".join(map(canonical_json, records)))


def count_by_category(items: Iterable[Item]) -> dict[str, int]:
    """Return the number of items per category name, in the order of `in_order`."""
    counts = Counter(item.category for item in items)
    return {slug: counts[slug] for slug in in_order(counts)}


def missing_categories(items: Iterable[Item]) -> list[str]:
    """Return the names of the twelve categories without any item: an average over the others must say so.

    None are missing in a suite of one's own categories alone, which is not measured against the twelve.
    """
    present = count_by_category(items)
    if not any(slug in CATEGORIES for slug in present):
        return []
    return [slug for slug in CATEGORIES if slug not in present]


@dataclass(frozen=True)
class Suite:
    """Items with a name, a version and a content hash.

    Attributes:
        card: Content of `suite.json`.
        selected_from: The suite from which `select` chose these items; None for a whole suite.
    """

    name: str
    version: str
    items: tuple[Item, ...]
    folder: Path
    card: dict[str, Any]
    selected_from: "Suite | None" = field(default=None, compare=False, repr=False)

    def __repr__(self) -> str:
        counts = ", ".join(f"{category} {count}" for category, count in count_by_category(self.items).items())
        return f"<Suite {self.identity}: {plural(len(self.items), 'item')} ({counts}) in {self.folder}>"

    @cached_property
    def content_sha256(self) -> str:
        """The hex sha256 of the suite's identity, see `content_sha256_of`."""
        return self.content_sha256_of(self.items)

    def content_sha256_of(self, items: Iterable[Item]) -> str:
        """Return the hex sha256 of name, version, format, and the content of items in any order.

        The items are those of the suite, or some of them. Suites are compared by this hash. Seeds come from
        `questions_sha256`, which does not depend on pairs and versions.
        """
        head = {"name": self.name, "version": self.version, "schema_version": self.schema_version}
        return _sha256_of_lines([head, *(item.content for item in _by_id(items))])

    @cached_property
    def questions_sha256(self) -> str:
        """The hex sha256 of what the items ask and show, see `questions_sha256`."""
        return questions_sha256(self.items)

    @property
    def schema_version(self) -> str:
        """The version of the format that `suite.json` names."""
        return str(self.card.get("schema_version", SCHEMA_VERSION))

    @property
    def identity(self) -> str:
        """The name `name@version#first12` under which results name the suite that they were made with."""
        return f"{self.name}@{self.version}#{self.content_sha256[:12]}"

    @property
    def seed_text(self) -> str:
        """The text `name@version#first12` of the questions; it seeds the suite's intervals and p values.

        Two suites of one name and version that differ in pairs alone give the same draws.
        """
        return f"{self.name}@{self.version}#{self.questions_sha256[:12]}"

    @property
    def parent(self) -> str | None:
        """The content hash of the suite that this one was selected from; None for a whole suite."""
        return self.card.get("parent")

    @property
    def complete(self) -> "Suite":
        """The suite that this one was selected from; the suite itself if it is whole."""
        return self if self.selected_from is None else self.selected_from.complete

    @property
    def categories(self) -> tuple[str, ...]:
        """The names of the categories that have items, in the order of `in_order`."""
        return tuple(count_by_category(self.items))

    def episodes(self) -> list[Episode]:
        """Return every item in both layouts, in the order of the items."""
        return [Episode(item, layout) for item in self.items for layout in LAYOUTS]

    def select(self, categories: Sequence[str] | None = None, items_per_category: int | None = None) -> "Suite":
        """Select the first items of some categories, as a suite with its own hash and this one as its parent.

        Raises:
            UnknownCategoryError: For a category the suite lacks.
            UsageError: For no category, or a number that is not positive, exceeds what a category has, or would
                separate role-exchanged twins.
        """
        selected = self.categories if categories is None else check_categories(categories, self.categories)
        if not selected:
            raise UsageError("no category selected. Name at least one, or leave `categories` out for all.")
        item_ids = {
            item.item_id for category in selected for item in self._first_items(category, items_per_category)
        }
        if len(item_ids) == len(self.items):
            return self
        items = tuple(item for item in self.items if item.item_id in item_ids)
        card = self.card | {
            "parent": self.content_sha256,
            "counts": count_by_category(items),
            "missing": missing_categories(items),
            "content_sha256": self.content_sha256_of(items),
        }
        return Suite(self.name, self.version, items, self.folder, card, selected_from=self)

    def _first_items(self, category: str, count: int | None) -> list[Item]:
        items = [item for item in self.items if item.category == category]
        if count is None:
            return items
        if not 0 < count <= len(items):
            raise UsageError(
                f"{count} items per category are asked for, and {category!r} has {plural(len(items), 'item')}; "
                f"give a number from 1 to {len(items)}."
            )
        first, dropped = items[:count], items[count:]
        separated = {item.pair_id for item in first} & {item.pair_id for item in dropped}
        if separated:
            raise UsageError(
                f"{count} items per category would keep one of the role-exchanged twins "
                f"{min(separated)!r} of {category!r} and drop the other. Give an even number."
            )
        return first


def new_suite(
    name: str,
    version: str,
    items: tuple[Item, ...],
    options: Mapping[str, Any],
    extra: Mapping[str, Any] | None = None,
) -> Suite:
    """Make a suite in memory, ready to be saved.

    The card has no date: the same options give the same bytes.

    Args:
        name: Name of the suite.
        version: Version of the suite, such as `1.0.0`.
        items: Items with their groups, see `with_groups`.
        options: Options that the suite was built or converted with.
        extra: Further entries of its card; None for none.
    """
    card = {
        "name": name,
        "version": version,
        "schema_version": SCHEMA_VERSION,
        "tool": {"probe_kit": __version__},
        "options": dict(options),
        "counts": count_by_category(items),
        "missing": missing_categories(items),
        "sources": sorted({item.source["benchmark"] for item in items}),
        "curation": sorted({item.curation_status for item in items}),
        "licenses": sorted({item.license for item in items}),
        "contains_real_faces": any(item.contains_real_face for item in items),
        "environment": drawing_libraries(),
        **(extra or {}),
    }
    suite = Suite(name, version, items, Path(), card)
    card["content_sha256"] = suite.content_sha256
    return suite


def drawing_libraries() -> dict[str, str]:
    """Return the versions of libraries on which the pixels of a drawn picture can depend."""
    freetype = features.version("freetype2") or "none"
    return {"pillow": PIL.__version__, "freetype": freetype, "numpy": np.__version__}


# -- pictures and items ------------------------------------------------------------------------------------------


_TRANSFER_TYPES = {
    **dict.fromkeys(("shape", "symmetry", "counting", "time", "celebrity"), "moderate"),
    "living-world": "heavy",
}
"""Transfer types of the paper's categories; `near` for all others."""
_LARGEST, _SMALLEST = 512, 224  # pixels of a stored picture's side


@dataclass(frozen=True)
class Picture:
    """An encoded picture with all that an item records about it.

    Attributes:
        original_pixels: Hash of the pixels that it was made from; empty where they are its own.
        operation: Description of how those pixels were changed before.
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
    """Encode the picture without a change."""
    return Picture(image_id, encode_png(image), pixels_sha256(image))


def squared_picture(image_id: str, image: Image.Image, operation: str = "none") -> Picture:
    """Encode the picture on a white square of 224 to 512 pixels; `operation` describes earlier changes to it."""
    square = letterbox(image)
    size = min(max(square.width, _SMALLEST), _LARGEST)
    stored = square if square.width == size else square.resize((size, size), Image.Resampling.BICUBIC)
    return Picture(image_id, encode_png(stored), pixels_sha256(stored), pixels_sha256(image), operation)


def make_item(item_id: str, category: str, side: Side, pictures: tuple[Picture, Picture], **fields: Any) -> Item:
    """Make an item whose group is not known yet.

    Texts are composed (Unicode's form NFC).

    Args:
        item_id: Id of the item.
        category: Name of the category, the paper's or one's own.
        side: Side of the correct picture.
        pictures: The left and the right picture.
        **fields: Other fields of an `Item`: those without a common value for most items, and those with another
            value.
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
