from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from probe_kit.errors import UnknownCategoryError, UsageError
from probe_kit.suite import Suite
from probe_kit.suite.suite import questions_sha256


def test_the_hash_does_not_depend_on_the_order_of_the_items(small_suite: Suite) -> None:
    assert small_suite.content_sha256_of(reversed(small_suite.items)) == small_suite.content_sha256
    assert questions_sha256(reversed(small_suite.items)) == small_suite.questions_sha256


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("left_file_name", "elsewhere.png"),
        ("left_sha256", "0" * 64),
        ("license", "CC0-1.0"),
        ("attribution", "somebody"),
        ("split", "dev"),
        ("gen", {}),
        ("folder", Path("/elsewhere")),
    ],
)
def test_files_licences_and_places_do_not_enter_the_hash(small_suite: Suite, field: str, value: object) -> None:
    first, *others = small_suite.items
    changed = replace(first, **{field: value})
    assert small_suite.content_sha256_of([changed, *others]) == small_suite.content_sha256


@pytest.mark.parametrize(
    "field",
    [
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
    ],
)
def test_whatever_changes_the_question_changes_the_hash(small_suite: Suite, field: str) -> None:
    first, *others = small_suite.items
    changed = replace(first, **{field: getattr(first, field) + "!"})
    assert small_suite.content_sha256_of([changed, *others]) != small_suite.content_sha256
    assert questions_sha256([changed, *others]) != small_suite.questions_sha256


@pytest.mark.parametrize("field", ["pair_id", "schema_version"])
def test_other_twins_or_another_format_change_the_hash_and_no_seed(small_suite: Suite, field: str) -> None:
    """Intervals and p values are drawn by the questions; suites are compared by all that a run depends on."""
    first, *others = small_suite.items
    changed = replace(small_suite, items=(replace(first, **{field: getattr(first, field) + "!"}), *others))
    assert changed.content_sha256 != small_suite.content_sha256
    assert changed.items[0].content_sha256 != first.content_sha256
    assert changed.seed_text == small_suite.seed_text


@pytest.mark.parametrize("field", ["name", "version", "schema_version"])
def test_name_version_and_format_of_a_suite_stand_in_its_hash(small_suite: Suite, field: str) -> None:
    own = {field: "1.7"} if field != "schema_version" else {"card": small_suite.card | {field: "1.7"}}
    changed = replace(small_suite, **own)  # type: ignore[arg-type]
    assert changed.content_sha256 != small_suite.content_sha256
    assert changed.questions_sha256 == small_suite.questions_sha256


def test_identity_names_the_suite_its_version_and_its_content(small_suite: Suite) -> None:
    assert small_suite.identity == f"a2a-embedded@2.0.0#{small_suite.content_sha256[:12]}"
    assert small_suite.seed_text == f"a2a-embedded@2.0.0#{small_suite.questions_sha256[:12]}"


def test_categories_come_in_the_order_of_the_paper_whatever_the_order_of_the_items(small_suite: Suite) -> None:
    backwards = replace(small_suite, items=small_suite.items[::-1])
    assert backwards.categories == ("color", "shape")


def test_every_item_gives_an_original_and_then_a_swapped_episode(small_suite: Suite) -> None:
    episodes = small_suite.episodes()
    first = small_suite.items[0].item_id
    assert [episode.episode_id for episode in episodes[:2]] == [f"{first}:o", f"{first}:s"]
    assert len(episodes) == 2 * len(small_suite.items)


def test_both_layouts_show_the_correct_picture_on_opposite_sides(small_suite: Suite) -> None:
    original, swapped = small_suite.episodes()[:2]
    assert original.side_correct != swapped.side_correct
    assert original.picture(original.side_correct) == swapped.picture(swapped.side_correct)


@pytest.mark.slow
def test_over_both_layouts_no_instruction_leans_to_a_side(embedded: Suite) -> None:
    sides = Counter((episode.item.instruction, episode.side_correct) for episode in embedded.episodes())
    for instruction in {item.instruction for item in embedded.items}:
        assert sides[instruction, "left"] == sides[instruction, "right"]


def test_a_selection_has_its_own_hash_and_names_its_parent(small_suite: Suite) -> None:
    selected = small_suite.select(["shape"], 4)
    assert [item.category for item in selected.items] == ["shape"] * 4
    assert selected.parent == small_suite.content_sha256
    assert selected.card["content_sha256"] == selected.content_sha256 != small_suite.content_sha256
    assert selected.card["counts"] == {"shape": 4}


def test_selecting_everything_gives_the_suite_itself(small_suite: Suite) -> None:
    assert small_suite.select(["shape", "color"], 12) is small_suite
    assert small_suite.parent is None


def test_an_unknown_category_is_refused_with_the_nearest_name(small_suite: Suite) -> None:
    with pytest.raises(UnknownCategoryError, match=r"'colour'.*Did you mean 'color'"):
        small_suite.select(["colour"])


def test_selecting_no_category_is_refused(small_suite: Suite) -> None:
    with pytest.raises(UsageError, match="no category selected"):
        small_suite.select([])


def test_a_selection_never_separates_twins(small_suite: Suite) -> None:
    said = r"5 items per category would keep .*twins .*'a2a-embedded-color-s0-0002'.* an even number"
    with pytest.raises(UsageError, match=said):
        small_suite.select(["color"], 5)


@pytest.mark.parametrize("count", [0, -2, 14])
def test_a_selection_of_more_or_fewer_items_than_there_can_be_is_refused(small_suite: Suite, count: int) -> None:
    with pytest.raises(UsageError, match=f"{count} items per category are asked for, and 'color' has 12 items"):
        small_suite.select(["color"], count)
