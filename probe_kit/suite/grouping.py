"""Groups of items, which folds must not separate, and counterparts: the same pictures, the other as target."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from probe_kit.hashing import sha256_json
from probe_kit.suite.items import Item


def ties(item: Item) -> tuple[str, ...]:
    """What ties an item to others: its pictures by content, their source identity, and its twins."""
    return (
        f"picture {item.left_pixels_sha256}",
        f"picture {item.right_pixels_sha256}",
        f"image {item.left_image_id}",
        f"image {item.right_image_id}",
        f"pair {item.pair_id}",
    )


def with_groups(items: Sequence[Item], named: Mapping[str, str] | None = None) -> tuple[Item, ...]:
    """The items with `group_id` set to their connected component over shared ties.

    named: by item id, a group that a user gave; it ties as a shared picture does. The name of a group is a hash of
    its members' ids, so it does not depend on the order of the items.
    """
    forest = _Forest()
    for item in items:
        for tie in ties(item):
            forest.join(item.item_id, tie)
        if named and item.item_id in named:
            forest.join(item.item_id, f"named {named[item.item_id]}")
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

    def join(self, one: str, other: str) -> None:
        self._parent[self.root(one)] = self.root(other)


def counterparts_of(items: Iterable[Item]) -> Mapping[str, Item]:
    """By item id the twin of every item that has one.

    A twin shows the same two pictures, asks for the other one in other words, and is of the same category; how the
    two lie, which suite they come from and how ids are made plays no part. Of several, the first by item id.
    """
    shown: dict[tuple[str, frozenset[str]], list[Item]] = defaultdict(list)
    for item in items:
        pictures = frozenset({item.left_pixels_sha256, item.right_pixels_sha256})
        if len(pictures) == 2:
            shown[item.category, pictures].append(item)
    found: dict[str, Item] = {}
    for together in shown.values():
        for item in together:
            others = [other for other in together if _asks_otherwise(item, other)]
            if others:
                found[item.item_id] = min(others, key=lambda other: other.item_id)
    return found


def _asks_otherwise(item: Item, other: Item) -> bool:
    wanted, given = (own.pixels_sha256(own.correct_side) for own in (item, other))
    return wanted != given and item.instruction != other.instruction
