"""What twins are for: no answer without looking at both the pictures and the text."""

from collections import Counter, defaultdict
from dataclasses import fields

import numpy as np
import pytest

from probe_kit.suite import Item, Side, Suite
from probe_kit.suite.generators import GENERATORS

SIDES: tuple[Side, Side] = ("left", "right")


def twins_of(suite: Suite) -> list[tuple[Item, Item]]:
    pairs: dict[str, list[Item]] = defaultdict(list)
    for item in suite.items:
        pairs[item.pair_id].append(item)
    return [(first, second) for first, second in pairs.values()]


@pytest.mark.slow
def test_twins_show_the_same_pictures_in_the_same_places_and_ask_both_ways(embedded: Suite) -> None:
    for first, second in twins_of(embedded):
        assert [first.picture(side) for side in SIDES] == [second.picture(side) for side in SIDES]
        assert first.target_concept == second.distractor_concept
        assert first.distractor_concept == second.target_concept
        assert {first.correct_side, second.correct_side} == {"left", "right"}
        assert first.group_id == second.group_id


def test_every_concept_is_target_as_often_as_distractor(embedded: Suite) -> None:
    targets = Counter((item.category, item.target_concept) for item in embedded.items)
    assert targets == Counter((item.category, item.distractor_concept) for item in embedded.items)


@pytest.mark.parametrize("category", list(GENERATORS))
def test_each_original_layout_has_as_many_answers_left_as_right(embedded: Suite, category: str) -> None:
    sides = Counter(item.correct_side for item in embedded.items if item.category == category)
    assert sides["left"] == sides["right"] == 20


def test_no_phrase_leans_to_a_side_in_the_original_layout(embedded: Suite) -> None:
    lean: Counter[str] = Counter()
    for item in embedded.items:
        lean[item.object_phrase] += 1 if item.correct_side == "left" else -1
    assert max(map(abs, lean.values())) <= 2


def test_which_twin_comes_first_says_nothing_about_its_side(embedded: Suite) -> None:
    left_first = np.mean([first.correct_side == "left" for first, _ in twins_of(embedded)])
    assert abs(left_first - 0.5) < 3 * np.sqrt(0.25 / len(twins_of(embedded)))


def test_instructions_name_no_side_and_follow_one_form(embedded: Suite) -> None:
    for item in embedded.items:
        assert item.instruction == f"Put the cube on the {item.object_phrase}"
        assert not {"left", "right", "first", "second", "centre", "middle"} & set(item.instruction.lower().split())


def test_an_item_says_where_its_pictures_come_from_and_how_they_were_drawn(embedded: Suite) -> None:
    item = embedded.select(["color"], 2).items[0]
    assert item.source["benchmark"] == "a2a-embedded"
    assert (item.transfer_type, item.license, item.attribution) == ("procedural", "Apache-2.0", "probe_kit")
    assert item.gen["generator"] == item.category
    assert set(item.gen["left"]) == set(item.gen["right"])


def test_every_field_has_one_type_so_that_tables_can_be_inferred(embedded: Suite) -> None:
    for field in fields(Item):
        assert len({type(getattr(item, field.name)) for item in embedded.items}) == 1
        assert all(getattr(item, field.name) is not None for item in embedded.items)
