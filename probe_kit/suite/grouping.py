"""Groups of items, which folds must not separate, and counterparts: the same pictures, the other as target."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from probe_kit.hashing import sha256_json
from probe_kit.suite.items import Item


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
    """The items with `group_id` set to their connected component over shared ties.

    groups: by item id, a group that a user gave; it ties as a shared picture does. A group is called by a hash of
    its members' ids, so the name does not depend on the order of the items.
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

    A twin shows the same two pictures, asks for the other one in other words, and is of the same category; how the
    two lie, which suite they come from and how ids are made plays no part. Of several, the first by item id.
    """
    by_pictures: dict[tuple[str, frozenset[str]], list[Item]] = defaultdict(list)
    for item in items:
        pictures = frozenset({item.left_pixels_sha256, item.right_pixels_sha256})
        if len(pictures) == 2:
            by_pictures[item.category, pictures].append(item)
    twins: dict[str, Item] = {}
    for together in by_pictures.values():
        for item in together:
            candidates = [other for other in together if _asks_otherwise(item, other)]
            if candidates:
                twins[item.item_id] = min(candidates, key=lambda other: other.item_id)
    return twins


def _asks_otherwise(item: Item, other: Item) -> bool:
    target, other_target = (each.pixels_sha256(each.correct_side) for each in (item, other))
    return target != other_target and item.instruction != other.instruction
