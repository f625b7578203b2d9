"""What twins are for: no answer without looking at both the pictures and the text."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import pytest
from sklearn.ensemble import RandomForestClassifier
from sklearn.model_selection import GroupKFold, cross_val_predict

from probe_kit.suite import Item, Side, Suite, load_picture

SIDES: tuple[Side, Side] = ("left", "right")


def twins_of(suite: Suite) -> list[tuple[Item, Item]]:
    pairs: dict[str, list[Item]] = defaultdict(list)
    for item in suite.items:
        pairs[item.pair_id].append(item)
    return [(first, second) for first, second in pairs.values()]


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


@pytest.mark.parametrize("category", ["color", "shape", "counting"])
def test_each_original_layout_has_as_many_answers_left_as_right(embedded: Suite, category: str) -> None:
    sides = Counter(item.correct_side for item in embedded.items if item.category == category)
    assert sides["left"] == sides["right"] == 60


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
    item = embedded.items[0]
    assert item.source["benchmark"] == "a2a-embedded"
    assert (item.transfer_type, item.license, item.attribution) == ("procedural", "Apache-2.0", "probe_kit")
    assert item.gen["generator"] == item.category
    assert set(item.gen["left"]) == set(item.gen["right"])


def test_every_field_has_one_type_so_that_tables_can_be_inferred(embedded: Suite) -> None:
    for field in fields(Item):
        assert len({type(getattr(item, field.name)) for item in embedded.items}) == 1
        assert all(getattr(item, field.name) is not None for item in embedded.items)


# -- leakage -----------------------------------------------------------------------------------------


def statistics(item: Item, side: Side) -> list[float]:
    """What can be seen without recognising anything: colour, spread, ink, edges, file size, background."""
    pixels = np.asarray(load_picture(item.picture(side)).resize((64, 64)), np.float64)
    background = np.median(pixels[0], axis=0)
    ink = np.abs(pixels - background).sum(axis=2) > 60
    edges = np.abs(np.diff(pixels.mean(axis=2), axis=0)).mean()
    size = item.picture(side).stat().st_size
    return [*pixels.mean(axis=(0, 1)), *pixels.std(axis=(0, 1)), *background, ink.mean(), edges, size]


def picture_only_accuracy(items: Sequence[Item]) -> float:
    """Out-of-fold accuracy of a forest that sees statistics of both tiles in both layouts, and no text."""
    features, labels, groups = [], [], []
    for item in items:
        left, right = statistics(item, "left"), statistics(item, "right")
        features += [left + right, right + left]
        labels += [item.correct_side == "left", item.correct_side == "right"]
        groups += [item.group_id] * 2
    forest = RandomForestClassifier(60, random_state=0)
    predicted = cross_val_predict(forest, features, labels, groups=groups, cv=GroupKFold(5))
    return float(np.mean(predicted == np.array(labels)))


def three_standard_errors(items: Sequence[Item]) -> float:
    """For a coin, over items: the two layouts of an item are not independent."""
    return 3 * float(np.sqrt(0.25 / len(items)))


@pytest.mark.parametrize("category", ["color", "shape", "counting"])
def test_picture_statistics_alone_do_not_give_the_answer(embedded: Suite, category: str) -> None:
    items = embedded.select([category]).items
    assert abs(picture_only_accuracy(items) - 0.5) < three_standard_errors(items)


def test_picture_statistics_would_give_the_answer_if_only_one_twin_were_asked(embedded: Suite) -> None:
    def number_of(concept: str) -> int:
        return ["one", "two", "three", "four", "five", "six", "seven", "eight", "nine"].index(concept)

    always_more = [
        item
        for item in embedded.select(["counting"]).items
        if number_of(item.target_concept) > number_of(item.distractor_concept)
    ]
    assert picture_only_accuracy(always_more) > 0.5 + three_standard_errors(always_more)
