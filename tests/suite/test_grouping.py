from dataclasses import replace

from probe_kit.suite import Item, Suite
from probe_kit.suite.grouping import with_groups


def stranger(item: Item, name: str) -> Item:
    """A copy of `item` that shares nothing with any other."""
    return replace(
        item,
        item_id=name,
        pair_id=f"{name} pair",
        left_pixels_sha256=f"{name} left",
        right_pixels_sha256=f"{name} right",
        left_image_id=f"{name} left",
        right_image_id=f"{name} right",
    )


def groups(*items: Item) -> list[str]:
    return [item.group_id for item in with_groups(items)]


def test_items_that_share_nothing_are_groups_of_their_own(small_suite: Suite) -> None:
    one, other = groups(stranger(small_suite.items[0], "a"), stranger(small_suite.items[0], "b"))
    assert one != other


def test_one_shared_picture_image_or_pair_is_enough(small_suite: Suite) -> None:
    first, second = stranger(small_suite.items[0], "a"), stranger(small_suite.items[0], "b")
    for tie in ({"pair_id": first.pair_id}, {"left_image_id": first.right_image_id}):
        one, other = groups(first, replace(second, **tie))
        assert one == other
    one, other = groups(first, replace(second, left_pixels_sha256=first.right_pixels_sha256))
    assert one == other


def test_ties_chain(small_suite: Suite) -> None:
    ends = stranger(small_suite.items[0], "a"), stranger(small_suite.items[0], "c")
    bridge = replace(
        stranger(small_suite.items[0], "b"), left_image_id=ends[0].left_image_id, pair_id=ends[1].pair_id
    )
    assert len(set(groups(*ends))) == 2
    assert len(set(groups(*ends, bridge))) == 1


def test_group_names_do_not_depend_on_the_order_of_the_items(small_suite: Suite) -> None:
    assert with_groups(small_suite.items[::-1]) == small_suite.items[::-1]


def test_embedded_groups_are_the_twins(small_suite: Suite) -> None:
    members: dict[str, list[str]] = {}
    for item in small_suite.items:
        members.setdefault(item.group_id, []).append(item.pair_id)
    assert all(len(pairs) == 2 and len(set(pairs)) == 1 for pairs in members.values())
