"""Questions in words: phrases of objects, and templates."""

from dataclasses import replace
from pathlib import Path

import pytest

from probe_kit.errors import UsageError
from probe_kit.extract.prompts import (
    INSTRUCTION,
    P1,
    P2,
    SEEN,
    TEMPLATES,
    Phrase,
    Template,
    find_template,
    phrases,
    sides,
)
from probe_kit.suite import Suite, build_suite


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    categories = ["emotion", "color", "symmetry", "counting"]
    return build_suite(tmp_path_factory.mktemp("suite") / "some", categories, 20)


def test_every_item_has_its_phrase_with_the(suite: Suite) -> None:
    phrase_by_item = phrases(suite, "target")
    assert phrase_by_item.keys() == {item.item_id for item in suite.items}
    assert all(
        phrase.with_article in item.instruction
        for item, phrase in zip(suite.items, phrase_by_item.values(), strict=True)
    )


def test_the_distractors_phrase_is_what_the_twin_asks_for(suite: Suite) -> None:
    phrase_by_item = phrases(suite, "distractor")
    twins = {(item.pair_id, item.target_concept): item for item in suite.items}
    for item in suite.items:
        assert phrase_by_item[item.item_id] == Phrase.of(twins[item.pair_id, item.distractor_concept])


def test_without_a_twin_the_concept_is_exchanged_in_the_items_own_phrase(suite: Suite) -> None:
    item = next(item for item in suite.items if item.category == "color")
    alone = replace(suite, items=(item,))
    assert phrases(alone, "distractor")[item.item_id].text == f"{item.distractor_concept} shape"
    other = replace(suite, items=(replace(item, object_phrase="thing"),))
    with pytest.raises(UsageError, match="--query distractor: 1 of 1 items, in color"):
        phrases(other, "distractor")


def test_an_absent_object_is_named_by_neither_picture_and_repeats_with_the_seed(suite: Suite) -> None:
    some = suite.select(("color", "counting"))
    concept = {(item.category, item.object_phrase): item.target_concept for item in some.items}
    phrase_by_item = phrases(some, "absent")
    for item in some.items:
        absent_concept = concept[item.category, phrase_by_item[item.item_id].text]
        assert absent_concept not in (item.target_concept, item.distractor_concept)
    assert phrase_by_item == phrases(some, "absent")
    assert phrase_by_item != phrases(some, "absent", seed=1)


def test_a_comparison_is_asked_for_only_among_comparisons(suite: Suite) -> None:
    emotion = suite.select(("emotion",))
    compares = {item.object_phrase: item.polarity != "none" for item in emotion.items}
    assert len(set(compares.values())) == 2
    phrase_by_item = phrases(emotion, "absent")
    assert all(compares[phrase_by_item[item.item_id].text] == (item.polarity != "none") for item in emotion.items)


def test_a_category_of_two_concepts_has_nothing_absent(suite: Suite) -> None:
    with pytest.raises(UsageError, match="20 of 20 items, in symmetry"):
        phrases(suite.select(("symmetry",)), "absent")


RED = Phrase("red shape", "the")
CHOICE = "\n\nA left\nB right\n\nAnswer with the option's letter from the given choices directly."


def test_the_three_prompts_read_as_in_the_paper() -> None:
    assert SEEN.render(RED) == (
        "Do you see the red shape? Answer yes or no. If yes, specify where: left, center, or right."
    )
    assert P1.render(RED) == ('Do you see the red shape? If yes, specify where: "left" or "right".' + CHOICE)
    assert P2.render(RED) == "Put cube on red shape" + CHOICE
    assert list(TEMPLATES) == ["seen", "p1", "p2", "instruction"]


def test_a_name_without_an_article_gets_none() -> None:
    assert SEEN.render(Phrase("Ada Lovelace", "")).startswith("Do you see Ada Lovelace?")


def test_the_prompt_of_the_instruction_is_the_instruction_alone() -> None:
    assert INSTRUCTION.is_instruction
    assert INSTRUCTION.orders == ("original",)
    assert INSTRUCTION.render(RED, instruction="Put the {cube} on it") == "Put the {cube} on it"
    framed = Template("openvla", "What action should the robot take to {instruction}?")
    assert framed.is_instruction
    assert framed.render(RED, instruction="go") == "What action should the robot take to go?"


@pytest.mark.parametrize("template", [SEEN, P1, P2], ids=("seen", "p1", "p2"))
def test_the_swapped_order_exchanges_the_sides_and_nothing_else(template: Template) -> None:
    plain, swapped = (template.render(RED, order) for order in template.orders)
    exchanged = swapped.replace("left", "#").replace("right", "left").replace("#", "right")
    assert plain != swapped
    assert exchanged.replace('"right" or "left"', '"left" or "right"') == plain
    assert sides("original") == sides("swapped")[::-1] == ("left", "right")


def test_which_prompts_take_letters_and_which_take_no() -> None:
    assert [(prompt.lettered, prompt.yes_or_no, prompt.tokens) for prompt in (SEEN, P1, P2)] == [
        (False, True, 24),
        (True, False, 8),
        (True, False, 8),
    ]


def test_a_file_is_a_prompt_of_its_own_name(tmp_path: Path) -> None:
    file = tmp_path / "my prompt.txt"
    file.write_text("Where is the {object}?\n(A) {A}\n(B) {B}\n", encoding="utf-8")
    mine = find_template(str(file))
    assert mine.name == "my-prompt"
    assert mine.lettered
    assert mine.render(RED, "swapped") == "Where is the red shape?\n(A) right\n(B) left"
    file.write_text("Where is {object}, on the left or on the right?", encoding="utf-8")
    free = find_template(str(file))
    assert (free.lettered, free.orders) == (False, ("original",))
    assert free.sha256 != mine.sha256


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("Where is it? A {A} B {B}", "places A, B; expected {object} once"),
        ("Where is {object}? A {A}", "{A} and {B} once each or not at all"),
        ("Where is {object} of {color}?", "place {color}"),
        ("{instruction} Where is {object}?", "place {instruction}; expected .* or {instruction} and no other"),
        ("{object}, {object}", "once"),
        ("Is {object} B {B} or A {A}? A {A}", "once each"),
    ],
)
def test_places_that_no_prompt_has_are_refused(text: str, match: str) -> None:
    with pytest.raises(UsageError, match=match):
        Template("mine", text)


def test_an_unknown_prompt_and_a_binary_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no prompt 'p3'; known: seen, p1, p2"):
        find_template("p3")
    file = tmp_path / "picture.png"
    file.write_bytes(b"\x89PNG\xff")
    with pytest.raises(UsageError, match="not UTF-8 text"):
        find_template(str(file))
