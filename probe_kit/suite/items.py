"""Items and episodes: questions with two pictures, and rollouts of them in one layout; their words and groups.

The wording `knowledge` is the item's own instruction, and `named` says what the correct picture literally shows.
The wording `side` says where it is, and `neutral` asks for any picture. A model that fails `knowledge` and passes
`named` lacks the knowledge. One that fails `side` lacks the skill. The score of `neutral` is the share that needs
no instruction.

Folds must not separate a group. Counterparts show the same pictures, with the other one as target.
"""

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from probe_kit.errors import SuiteError, UsageError
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
    """Return the side opposite to `side`, seen from the robot base (left is +y)."""
    return "right" if side == "left" else "left"


@dataclass(frozen=True)
class Item:
    """One question: an imperative instruction, a correct and a wrong picture.

    `left` and `right` refer to the *original* layout; the swapped layout is derived, never stored.

    Attributes:
        side_word: Whether the item is a sign whose name contains a side word, such as "no left turn sign".
        wordings: Other texts in which the item can be asked, by name, see `WORDINGS`; no part of the item's
            identity.
        folder: Folder to which the file names are relative on this machine; no part of the item's identity.
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
        """The words, pictures, side and group of this item, by name, from which `Suite.seed_text` is made."""
        return {name: getattr(self, name) for name in _QUESTION}

    @property
    def content(self) -> dict[str, str]:
        """The fields that make this item the same in two suites, by name."""
        return {name: getattr(self, name) for name in _CONTENT}

    @property
    def content_sha256(self) -> str:
        """The hex sha256 of `content`: items with equal hashes ask and show the same, and have the same twin."""
        return sha256_json(self.content)

    def file_name(self, side: Side) -> str:
        """Return the name, relative to `folder`, of the picture that lies on `side` in the original layout."""
        return self.left_file_name if side == "left" else self.right_file_name

    def file_sha256(self, side: Side) -> str:
        """Return the hex sha256 of the bytes of that file."""
        return self.left_sha256 if side == "left" else self.right_sha256

    def pixels_sha256(self, side: Side) -> str:
        """Return the hash of the pixels of that picture, see `pictures.pixels_sha256`."""
        return self.left_pixels_sha256 if side == "left" else self.right_pixels_sha256

    def picture(self, side: Side) -> Path:
        """Return the absolute path of the picture that lies on `side` in the original layout."""
        return self.folder / self.file_name(side)

    @classmethod
    def from_json(cls, record: dict[str, Any], folder: Path) -> "Item":
        """Make the item from the record of `to_json`; fields that a later 1.x schema may add are left out."""
        names = {f.name for f in fields(cls)} - {"folder"}
        return cls(**{name: value for name, value in record.items() if name in names}, folder=folder)

    def to_json(self) -> dict[str, Any]:
        """Return the item as one line of `metadata.jsonl`; without other wordings it has no field for them."""
        left_out = {"folder"} if self.wordings else {"folder", "wordings"}
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in left_out}


@dataclass(frozen=True)
class Episode:
    """One rollout of an item in one layout.

    Attributes:
        wording: Name of the wording of `item.instruction`; None where only the item's own was requested.
    """

    item: Item
    layout: Layout
    wording: str | None = None

    @property
    def episode_id(self) -> str:
        """The id `<item_id>:o` or `<item_id>:s`, followed by `:<wording>` for all but the item's own words."""
        is_plain = self.wording in (None, "knowledge")
        return f"{self.item.item_id}:{self.layout[0]}" + ("" if is_plain else f":{self.wording}")

    @property
    def seed_id(self) -> str:
        """The name that seeds are derived from: the same in all wordings."""
        return f"{self.item.item_id}:{self.layout[0]}"

    @property
    def side_correct(self) -> Side:
        """The side on which the correct picture lies in this layout."""
        side = self.item.correct_side
        return side if self.layout == "original" else other_side(side)

    def picture(self, side: Side) -> Path:
        """Return the absolute path of the picture that lies on `side` in this layout."""
        return self.item.picture(self._original(side))

    def pixels_sha256(self, side: Side) -> str:
        """Return the hash of the pixels of that picture, see `pictures.pixels_sha256`."""
        return self.item.pixels_sha256(self._original(side))

    def _original(self, side: Side) -> Side:
        return side if self.layout == "original" else other_side(side)


# -- words -------------------------------------------------------------------------------------------------------


VERBATIM = "verbatim"
"""Rule of items whose instruction is their source's own question, not a sentence of ours."""
MOST_WORDS = 12
MOST_CHARACTERS = 80
_SIDE_WORDS = frozenset(
    {"left", "right", "first", "second", "leftmost", "rightmost", "centre", "center", "middle"}
)


def instruction_for(object_phrase: str, article: str) -> str:
    """Return the imperative that names the object, with `article` "the", or "none" for bare names."""
    return f"Put the cube on {'the ' if article == 'the' else ''}{object_phrase}"


def side_words(text: str) -> tuple[str, ...]:
    """Return the words that name a side or a place in a row: they would collide with the answers.

    The answers are left and right.
    """
    return tuple(word for word in re.findall(r"[a-z]+", text.lower()) if word in _SIDE_WORDS)


Wording = Literal["knowledge", "named", "side", "neutral"]
WORDINGS: tuple[Wording, ...] = ("knowledge", "named", "side", "neutral")
SIDE = "Put the cube on the {side} picture"
NEUTRAL = "Put the cube on one of the two pictures"
"""Texts of `side` and `neutral` where an item has no words of its own for them."""


def check_wordings(names: Sequence[str]) -> tuple[Wording, ...]:
    """Return the names, each once.

    Raises:
        UsageError: For an unknown name, for no name, or for one that comes twice.
    """
    unknown = [name for name in names if name not in WORDINGS]
    if unknown or not names:
        problem = repr(unknown[0]) if unknown else "empty"
        raise UsageError(f"wordings: {problem}; expected some of {', '.join(WORDINGS)}")
    if len(set(names)) < len(names):
        raise UsageError(f"wordings {','.join(names)}: one comes twice; name each once")
    return tuple(name for name in names if name in WORDINGS)


def in_words(episode: Episode, wording: Wording) -> Episode | None:
    """Return the episode with its instruction in `wording`, or None where the item has none.

    An item's `wordings` are its texts by name; `{side}` stands for the side of the correct picture in the layout.

    Raises:
        SuiteError: If the item's wording `side` lacks `{side}`: it would then be the same in both layouts.
    """
    item = episode.item
    wording_text = item.wordings.get(wording)
    if wording == "knowledge":
        text: str | None = item.instruction
    elif wording == "side":
        text = SIDE if wording_text is None else wording_text
        if "{side}" not in text:
            raise SuiteError(
                f"item {item.item_id}: its wording 'side' is {text!r}; expected a text that contains '{{side}}', "
                "which stands for left or right. Correct it in the suite's metadata."
            )
        text = text.replace("{side}", episode.side_correct)
    else:
        text = NEUTRAL if wording_text is None and wording == "neutral" else wording_text
    return None if not text else replace(episode, item=replace(item, instruction=text), wording=wording)


# -- groups ------------------------------------------------------------------------------------------------------


def ties(item: Item) -> tuple[str, ...]:
    """Return the ties of an item to others: its pictures by content, their source identity, and its twins."""
    return (
        f"picture {item.left_pixels_sha256}",
        f"picture {item.right_pixels_sha256}",
        f"image {item.left_image_id}",
        f"image {item.right_image_id}",
        f"pair {item.pair_id}",
    )


def with_groups(items: Sequence[Item], groups: Mapping[str, str] | None = None) -> tuple[Item, ...]:
    """Return the items with `group_id` set to their connected component over shared ties.

    The name of a group is a hash of its members' ids, so it does not depend on the order of the items.

    Args:
        items: Items of one suite.
        groups: By item id, a group that a user gave; it ties as a shared picture does. None without such groups.
    """
    forest = _Forest()
    for item in items:
        for tie in ties(item):
            forest.join(item.item_id, tie)
        if groups and item.item_id in groups:
            forest.join(item.item_id, f"named {groups[item.item_id]}")
    members: dict[str, list[str]] = {}
    for item in items:
        members.setdefault(forest.root(item.item_id), []).append(item.item_id)
    names = {root: f"g-{sha256_json(sorted(ids))[:12]}" for root, ids in members.items()}
    return tuple(replace(item, group_id=names[forest.root(item.item_id)]) for item in items)


class _Forest:
    """Union-find over strings."""

    def __init__(self) -> None:
        self._parent: dict[str, str] = {}

    def root(self, node: str) -> str:
        self._parent.setdefault(node, node)
        while self._parent[node] != node:
            self._parent[node] = self._parent[self._parent[node]]
            node = self._parent[node]
        return node

    def join(self, node: str, other: str) -> None:
        self._parent[self.root(node)] = self.root(other)


def counterparts_of(items: Iterable[Item]) -> Mapping[str, Item]:
    """Return by item id the twin of every item that has one.

    A twin shows the same two pictures, asks for the other one in other words, and is of the same category. The
    places of the two pictures, their suite and the form of ids do not matter. Of several twins, it is the first by
    item id.
    """
    by_pictures: dict[tuple[str, frozenset[str]], list[Item]] = defaultdict(list)
    for item in items:
        pictures = frozenset({item.left_pixels_sha256, item.right_pixels_sha256})
        if len(pictures) == 2:
            by_pictures[item.category, pictures].append(item)
    twins: dict[str, Item] = {}
    for together in by_pictures.values():
        for item in together:
            target = item.pixels_sha256(item.correct_side)
            candidates = [
                other
                for other in together
                if other.pixels_sha256(other.correct_side) != target and other.instruction != item.instruction
            ]
            if candidates:
                twins[item.item_id] = min(candidates, key=lambda other: other.item_id)
    return twins
