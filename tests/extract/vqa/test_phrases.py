"""What questions name comes from the items, and what no picture shows is really on neither."""

from dataclasses import replace

import pytest

from probe_kit.errors import UsageError
from probe_kit.extract.prompts import Phrase, phrases
from probe_kit.suite import Suite, build_suite


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    categories = ["emotion", "color", "symmetry", "counting"]
    return build_suite(tmp_path_factory.mktemp("suite") / "some", categories, 20)


def test_every_item_has_its_phrase_with_the(suite: Suite) -> None:
    found = phrases(suite, "target")
    assert found.keys() == {item.item_id for item in suite.items}
    assert all(
        phrase.with_article in item.instruction for item, phrase in zip(suite.items, found.values(), strict=True)
    )


def test_the_distractors_phrase_is_what_the_twin_asks_for(suite: Suite) -> None:
    found = phrases(suite, "distractor")
    twins = {(item.pair_id, item.target_concept): item for item in suite.items}
    for item in suite.items:
        assert found[item.item_id] == Phrase.of(twins[item.pair_id, item.distractor_concept])


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
    found = phrases(some, "absent")
    for item in some.items:
        named = concept[item.category, found[item.item_id].text]
        assert named not in (item.target_concept, item.distractor_concept)
    assert found == phrases(some, "absent")
    assert found != phrases(some, "absent", seed=1)


def test_a_comparison_is_asked_for_only_among_comparisons(suite: Suite) -> None:
    emotion = suite.select(("emotion",))
    compares = {item.object_phrase: item.polarity != "none" for item in emotion.items}
    assert len(set(compares.values())) == 2
    found = phrases(emotion, "absent")
    assert all(compares[found[item.item_id].text] == (item.polarity != "none") for item in emotion.items)


def test_a_category_of_two_concepts_has_nothing_absent(suite: Suite) -> None:
    with pytest.raises(UsageError, match="20 of 20 items, in symmetry"):
        phrases(suite.select(("symmetry",)), "absent")
