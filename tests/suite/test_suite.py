"""Groups and counterparts of items."""

from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from probe_kit.errors import SuiteError, UnknownCategoryError, UsageError
from probe_kit.suite import Episode, Item, Suite, build_suite, validate_suite
from probe_kit.suite.generators.public_info import PICTOGRAMS
from probe_kit.suite.items import (
    WORDINGS,
    check_wordings,
    counterparts_of,
    in_words,
    other_side,
    side_words,
    with_groups,
)
from probe_kit.suite.rules import check_record
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
    first, *other_items = small_suite.items
    changed = replace(first, **{field: value})
    assert small_suite.content_sha256_of([changed, *other_items]) == small_suite.content_sha256


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
    first, *other_items = small_suite.items
    changed = replace(first, **{field: getattr(first, field) + "!"})
    assert small_suite.content_sha256_of([changed, *other_items]) != small_suite.content_sha256
    assert questions_sha256([changed, *other_items]) != small_suite.questions_sha256


@pytest.mark.parametrize("field", ["pair_id", "schema_version"])
def test_other_twins_or_another_format_change_the_hash_and_no_seed(small_suite: Suite, field: str) -> None:
    """Intervals and p values are drawn by the questions; suites are compared by all that a run depends on."""
    first, *other_items = small_suite.items
    changed = replace(small_suite, items=(replace(first, **{field: getattr(first, field) + "!"}), *other_items))
    assert changed.content_sha256 != small_suite.content_sha256
    assert changed.items[0].content_sha256 != first.content_sha256
    assert changed.seed_text == small_suite.seed_text


@pytest.mark.parametrize("field", ["name", "version", "schema_version"])
def test_name_version_and_format_of_a_suite_stand_in_its_hash(small_suite: Suite, field: str) -> None:
    changes = {field: "1.7"} if field != "schema_version" else {"card": small_suite.card | {field: "1.7"}}
    changed = replace(small_suite, **changes)  # type: ignore[arg-type]
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
    reason = r"5 items per category would keep .*twins .*'a2a-embedded-color-s0-0002'.* an even number"
    with pytest.raises(UsageError, match=reason):
        small_suite.select(["color"], 5)


@pytest.mark.parametrize("count", [0, -2, 14])
def test_a_selection_of_more_or_fewer_items_than_there_can_be_is_refused(small_suite: Suite, count: int) -> None:
    with pytest.raises(UsageError, match=f"{count} items per category are asked for, and 'color' has 12 items"):
        small_suite.select(["color"], count)


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
    first_group, other = groups(stranger(small_suite.items[0], "a"), stranger(small_suite.items[0], "b"))
    assert first_group != other


def test_one_shared_picture_image_or_pair_is_enough(small_suite: Suite) -> None:
    first, second = stranger(small_suite.items[0], "a"), stranger(small_suite.items[0], "b")
    for tie in ({"pair_id": first.pair_id}, {"left_image_id": first.right_image_id}):
        first_group, other = groups(first, replace(second, **tie))
        assert first_group == other
    first_group, other = groups(first, replace(second, left_pixels_sha256=first.right_pixels_sha256))
    assert first_group == other


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
    item = small_suite.items[0]
    return item, counterparts_of(small_suite.items)[item.item_id]


def test_an_item_whose_twin_is_not_there_has_none(pair: tuple[Item, Item]) -> None:
    assert counterparts_of(pair[:1]) == {}


@pytest.mark.parametrize(
    "name", ["instruction", "correct_side", "left_pixels_sha256", "category"], ids=lambda name: name
)
def test_what_asks_for_the_same_or_shows_another_picture_is_no_twin(pair: tuple[Item, Item], name: str) -> None:
    item, twin = pair
    same = {"instruction": item.instruction, "correct_side": item.correct_side}
    other = replace(twin, **{name: same.get(name, "another")})
    assert counterparts_of([item, other]) == {}


def test_an_item_of_one_picture_twice_has_no_twin(pair: tuple[Item, Item]) -> None:
    alike = [replace(item, left_pixels_sha256=item.right_pixels_sha256) for item in pair]
    assert counterparts_of(alike) == {}


def test_how_the_pictures_lie_plays_no_part(pair: tuple[Item, Item]) -> None:
    """Only its words are used, so that the layouts may differ."""
    item, twin = pair
    turned = replace(
        twin,
        left_pixels_sha256=twin.right_pixels_sha256,
        right_pixels_sha256=twin.left_pixels_sha256,
        correct_side=other_side(twin.correct_side),
    )
    assert counterparts_of([item, turned])[item.item_id] is turned


def test_ids_and_pair_ids_play_no_part(pair: tuple[Item, Item]) -> None:
    """So that a converted suite, whose ids are its source's, has twins as well."""
    original, twin = pair
    other = replace(twin, pair_id="elsewhere-7", item_id="zzz")
    assert counterparts_of([original, other])[original.item_id] is other
    assert counterparts_of([original, other, twin])[original.item_id] is min(
        other, twin, key=lambda item: item.item_id
    )


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    return build_suite(tmp_path_factory.mktemp("ladder") / "suite", ["emotion", "color", "public-info"], 6)


def of_category(suite, category):
    return next(item for item in suite.items if item.category == category)


def texts(item, layout="original"):
    worded = {wording: in_words(Episode(item, layout), wording) for wording in WORDINGS}
    return {name: None if episode is None else episode.item.instruction for name, episode in worded.items()}


@pytest.mark.slow
def test_an_item_is_asked_by_what_it_means_by_what_it_shows_by_where_it_lies_and_by_nothing(suite):
    item = of_category(suite, "color")
    wordings = texts(item)
    color = item.target_concept
    outline = item.gen[item.correct_side]["outline"]
    assert wordings == {
        "knowledge": f"Put the cube on the {color} shape",
        "named": f"Put the cube on the {color} {outline}",
        "side": f"Put the cube on the {item.correct_side} picture",
        "neutral": "Put the cube on one of the two pictures",
    }


def test_the_side_follows_the_layout_and_nothing_else_does(suite):
    item = of_category(suite, "color")
    original, swapped = texts(item, "original"), texts(item, "swapped")
    assert {original.pop("side"), swapped.pop("side")} == {
        f"Put the cube on the {s} picture" for s in ("left", "right")
    }
    assert original == swapped


def test_a_category_whose_pictures_have_no_plainer_words_has_no_wording_named(suite):
    assert texts(of_category(suite, "emotion"))["named"] is None


def test_words_that_fit_both_pictures_are_none(suite):
    named_items = [item for item in suite.items if "named" in item.wordings]
    assert named_items
    for item in named_items:
        twin = next(other for other in suite.items if other.pair_id == item.pair_id and other != item)
        assert item.wordings["named"] != twin.wordings.get("named")
        assert item.wordings["named"] != item.instruction


def test_no_pictogram_is_named_by_what_it_stands_for():
    pictograms = [pictogram for pictogram in PICTOGRAMS if pictogram.shows]
    assert len(pictograms) > 30
    assert not [p.name for p in pictograms if p.name in p.shows]
    assert not [p.name for p in pictograms if side_words(p.shows)]


def test_episodes_keep_the_id_of_the_items_own_words_and_all_share_its_seeds(suite):
    item = of_category(suite, "color")
    plain = Episode(item, "swapped")
    worded = [in_words(plain, wording) for wording in WORDINGS]
    assert [episode.episode_id.removeprefix(plain.episode_id) for episode in worded] == [
        "",
        ":named",
        ":side",
        ":neutral",
    ]
    assert {episode.seed_id for episode in worded} == {plain.seed_id} == {plain.episode_id}


def test_a_suite_may_say_it_in_its_own_words(suite):
    custom_wordings = {"side": "Put it {side}", "neutral": "Put it anywhere"}
    item = replace(of_category(suite, "emotion"), wordings=custom_wordings)
    assert texts(item)["side"] == f"Put it {item.correct_side}"
    assert texts(item)["neutral"] == "Put it anywhere"
    with pytest.raises(SuiteError, match=r"contains '\{side\}'"):
        in_words(Episode(replace(item, wordings={"side": "Put it left"}), "original"), "side")


@pytest.mark.parametrize("names", [(), ("knowledge", "nmaed"), ("side", "side")])
def test_wordings_that_do_not_exist_or_come_twice_are_refused(names):
    with pytest.raises(UsageError, match="wordings"):
        check_wordings(names)


def test_wordings_survive_the_suites_file_and_are_left_out_where_there_are_none(suite):
    for item in suite.items:
        record = item.to_json()
        assert ("wordings" in record) == bool(item.wordings)
        assert Item.from_json(record, item.folder) == item
    assert not [finding for finding in validate_suite(suite.folder).findings if finding.severity == "error"]


@pytest.mark.parametrize(
    "wordings",
    ["named", {"nmaed": "x"}, {"named": ""}, {"named": 3}, {"side": "the left one"}, {"named": "the {side} one"}],
)
def test_a_suite_with_wordings_that_mean_nothing_is_refused(wordings, suite):
    record = of_category(suite, "emotion").to_json() | {"wordings": wordings}
    assert [finding.rule for finding in check_record(record, "line 1")] == ["E02"]


def test_wordings_change_no_suites_identity(suite):
    assert suite.content_sha256_of(replace(item, wordings={}) for item in suite.items) == suite.content_sha256


@pytest.mark.slow
def test_no_plainer_words_name_a_side_though_a_right_triangle_is_drawn(tmp_path):
    drawn = build_suite(tmp_path / "color", ["color"], 60)
    triangles = [i for i in drawn.items if i.gen[i.correct_side]["outline"] == "right triangle"]
    assert triangles
    assert not [i for i in drawn.items if side_words(i.wordings.get("named", ""))]
    assert not [i for i in triangles if "named" in i.wordings]


def types_of(value: Any, path: str, types_by_key: dict[str, set[str]]) -> None:
    """Collects the type of every key, at any depth."""
    if isinstance(value, dict):
        for key, inner in value.items():
            types_of(inner, f"{path}.{key}", types_by_key)
    elif isinstance(value, list | tuple):
        for inner in value:
            types_of(inner, f"{path}[]", types_by_key)
    else:
        types_by_key[path].add(type(value).__name__)


def test_every_key_has_one_type_in_all_categories(embedded: Suite) -> None:
    """Arrow infers one type per key; a key that is a number here and a text there cannot be read."""
    types_by_key: dict[str, set[str]] = defaultdict(set)
    for item in embedded.items:
        types_of(item.to_json(), "", types_by_key)
    assert {path: types for path, types in types_by_key.items() if len(types) > 1} == {}


def test_the_imagefolder_reader_finds_both_pictures(small_suite: Suite) -> None:
    datasets = pytest.importorskip("datasets", reason="the optional package `datasets` is not installed")
    loaded = datasets.load_dataset("imagefolder", data_dir=str(small_suite.folder / "items"), split="train")
    assert len(loaded) == len(small_suite.items)
    assert loaded[0]["left"].size == loaded[0]["right"].size == (256, 256)
    assert loaded[0]["instruction"] == small_suite.items[0].instruction
