"""Items and episodes: one question with two pictures, and one rollout of it in one layout."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from probe_kit.hashing import sha256_json

Side = Literal["left", "right"]
Layout = Literal["original", "swapped"]
LAYOUTS: tuple[Layout, Layout] = ("original", "swapped")
SCHEMA_VERSION = "1.0"
"""Format of the suites that are written."""
# What is asked, what the pictures show, and which items are drawn together. Random draws are seeded with these
# fields, so a field that is added here moves intervals and Monte-Carlo p values: it belongs in _CONTENT instead.
_QUESTION = (
    "item_id",
    "category",
    "instruction",
    "object_phrase",
    "object_article",
    "correct_side",
    "left_pixels_sha256",
    "right_pixels_sha256",
    "target_concept",
    "distractor_concept",
    "group_id",
)
# What makes two items, and so two suites, the same. File names, encoders and licences may differ.
_CONTENT = (*_QUESTION, "pair_id", "schema_version")


def other_side(side: Side) -> Side:
    """The side opposite to `side`, seen from the robot base (left is +y)."""
    return "right" if side == "left" else "left"


@dataclass(frozen=True)
class Item:
    """One question: an imperative instruction, a correct and a wrong picture.

    `left` and `right` refer to the *original* layout; the swapped layout is derived, never stored.
    `side_word` marks a sign whose name holds a side word, such as "no left turn sign".
    `wordings`: what else the item can be asked in, by name, see `suite.wording`; no part of the item's identity.
    `folder` is what the file names are relative to on this machine; it takes no part in the item's identity.
    """

    item_id: str
    category: str
    domain: str
    transfer_type: str
    construction: str
    instruction: str
    object_phrase: str
    object_article: str
    polarity: str
    target_concept: str
    distractor_concept: str
    correct_side: Side
    left_file_name: str
    right_file_name: str
    left_sha256: str
    right_sha256: str
    left_pixels_sha256: str
    right_pixels_sha256: str
    left_image_id: str
    right_image_id: str
    group_id: str
    pair_id: str
    rule_id: str
    curation_status: str
    license: str
    attribution: str
    redistributable: bool
    contains_real_face: bool
    split: str
    source: dict[str, Any]
    gen: dict[str, Any]
    schema_version: str = SCHEMA_VERSION
    side_word: bool = False
    wordings: dict[str, str] = field(default_factory=dict)
    folder: Path = field(default=Path(), compare=False)

    @property
    def question(self) -> dict[str, str]:
        """The words, pictures, side and group of this item, by name: what `Suite.seed_text` is made of."""
        return {name: getattr(self, name) for name in _QUESTION}

    @property
    def content(self) -> dict[str, str]:
        """The fields that make this item the same in two suites, by name."""
        return {name: getattr(self, name) for name in _CONTENT}

    @property
    def content_sha256(self) -> str:
        """Hex sha256 of `content`: items with equal hashes ask and show the same, and have the same twin."""
        return sha256_json(self.content)

    def file_name(self, side: Side) -> str:
        """Name, relative to `folder`, of the picture that lies on `side` in the original layout."""
        return self.left_file_name if side == "left" else self.right_file_name

    def file_sha256(self, side: Side) -> str:
        """Hex sha256 of the bytes of that file."""
        return self.left_sha256 if side == "left" else self.right_sha256

    def pixels_sha256(self, side: Side) -> str:
        """Hash of the pixels of that picture, see `pictures.pixels_sha256`."""
        return self.left_pixels_sha256 if side == "left" else self.right_pixels_sha256

    def picture(self, side: Side) -> Path:
        """Absolute path of the picture that lies on `side` in the original layout."""
        return self.folder / self.file_name(side)

    @classmethod
    def from_json(cls, record: dict[str, Any], folder: Path) -> "Item":
        """The item that `to_json` gave; fields that a later 1.x schema may add are left out."""
        names = {f.name for f in fields(cls)} - {"folder"}
        return cls(**{name: value for name, value in record.items() if name in names}, folder=folder)

    def to_json(self) -> dict[str, Any]:
        """The item as one line of `metadata.jsonl`; without other wordings it has no field for them."""
        left_out = {"folder"} if self.wordings else {"folder", "wordings"}
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in left_out}


@dataclass(frozen=True)
class Episode:
    """One rollout of an item in one layout.

    wording: the name of the wording that `item.instruction` is in, None where only its own was asked for.
    """

    item: Item
    layout: Layout
    wording: str | None = None

    @property
    def episode_id(self) -> str:
        """`<item_id>:o` or `<item_id>:s`, and `:<wording>` behind it for all but the item's own words."""
        is_plain = self.wording in (None, "knowledge")  # `suite.wording` has the name, and imports this module
        return f"{self.item.item_id}:{self.layout[0]}" + ("" if is_plain else f":{self.wording}")

    @property
    def seed_id(self) -> str:
        """The name that seeds are derived from: the same in all wordings."""
        return f"{self.item.item_id}:{self.layout[0]}"

    @property
    def side_correct(self) -> Side:
        """Side on which the correct picture lies in this layout."""
        side = self.item.correct_side
        return side if self.layout == "original" else other_side(side)

    def picture(self, side: Side) -> Path:
        """Absolute path of the picture that lies on `side` in this layout."""
        return self.item.picture(self._original(side))

    def pixels_sha256(self, side: Side) -> str:
        """Hash of the pixels of that picture, see `pictures.pixels_sha256`."""
        return self.item.pixels_sha256(self._original(side))

    def _original(self, side: Side) -> Side:
        return side if self.layout == "original" else other_side(side)
