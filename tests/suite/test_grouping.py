"""Groups and counterparts of items."""

from dataclasses import replace

import pytest

from probe_kit.suite import Item, Suite
from probe_kit.suite.items import counterparts_of, other_side, with_groups


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


def test_every_item_of_the_embedded_generators_has_its_twin(small_suite: Suite) -> None:
    twins = counterparts_of(small_suite.items)
    assert twins.keys() == {item.item_id for item in small_suite.items}
    for item in small_suite.items:
        twin = twins[item.item_id]
        assert twin.pair_id == item.pair_id
        assert twins[twin.item_id] is item
        assert twin.correct_side == other_side(item.correct_side)
        assert (twin.left_pixels_sha256, twin.right_pixels_sha256) == (
            item.left_pixels_sha256,
            item.right_pixels_sha256,
        )
        assert twin.instruction != item.instruction


@pytest.fixture
def pair(small_suite: Suite) -> tuple[Item, Item]:
    one = small_suite.items[0]
    return one, counterparts_of(small_suite.items)[one.item_id]


def test_an_item_whose_twin_is_not_there_has_none(pair: tuple[Item, Item]) -> None:
    assert counterparts_of(pair[:1]) == {}


@pytest.mark.parametrize(
    "name", ["instruction", "correct_side", "left_pixels_sha256", "category"], ids=lambda name: name
)
def test_what_asks_for_the_same_or_shows_another_picture_is_no_twin(pair: tuple[Item, Item], name: str) -> None:
    one, twin = pair
    same = {"instruction": one.instruction, "correct_side": one.correct_side}
    other = replace(twin, **{name: same.get(name, "another")})
    assert counterparts_of([one, other]) == {}


def test_an_item_of_one_picture_twice_has_no_twin(pair: tuple[Item, Item]) -> None:
    alike = [replace(own, left_pixels_sha256=own.right_pixels_sha256) for own in pair]
    assert counterparts_of(alike) == {}


def test_how_the_pictures_lie_plays_no_part(pair: tuple[Item, Item]) -> None:
    """Only its words are used, so that the layouts may differ."""
    one, twin = pair
    turned = replace(
        twin,
        left_pixels_sha256=twin.right_pixels_sha256,
        right_pixels_sha256=twin.left_pixels_sha256,
        correct_side=other_side(twin.correct_side),
    )
    assert counterparts_of([one, turned])[one.item_id] is turned


def test_ids_and_pair_ids_play_no_part(pair: tuple[Item, Item]) -> None:
    """So that a converted suite, whose ids are its source's, has twins as well."""
    one, twin = pair
    other = replace(twin, pair_id="elsewhere-7", item_id="zzz")
    assert counterparts_of([one, other])[one.item_id] is other
    assert counterparts_of([one, other, twin])[one.item_id] is min(other, twin, key=lambda item: item.item_id)
