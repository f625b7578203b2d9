"""Counterpart items: the same two pictures, with the other one as the target."""

from collections import defaultdict
from collections.abc import Iterable, Mapping

from probe_kit.suite.items import Item


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
