from dataclasses import replace

import pytest

from probe_kit.errors import SuiteError, UsageError
from probe_kit.suite import Episode, build_suite, validate_suite
from probe_kit.suite.generators.public_info import PICTOGRAMS
from probe_kit.suite.items import WORDINGS, Item, check_wordings, in_words, side_words
from probe_kit.suite.rules import check_record


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    return build_suite(tmp_path_factory.mktemp("ladder") / "suite", ["emotion", "color", "public-info"], 6)


def of_category(suite, category):
    return next(item for item in suite.items if item.category == category)


def texts(item, layout="original"):
    worded = {wording: in_words(Episode(item, layout), wording) for wording in WORDINGS}
    return {name: None if episode is None else episode.item.instruction for name, episode in worded.items()}


def test_an_item_is_asked_by_what_it_means_by_what_it_shows_by_where_it_lies_and_by_nothing(suite):
    item = of_category(suite, "color")
    found = texts(item)
    color = item.target_concept
    outline = item.gen[item.correct_side]["outline"]
    assert found == {
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
    named = [item for item in suite.items if "named" in item.wordings]
    assert named
    for item in named:
        twin = next(other for other in suite.items if other.pair_id == item.pair_id and other != item)
        assert item.wordings["named"] != twin.wordings.get("named")
        assert item.wordings["named"] != item.instruction


def test_no_pictogram_is_named_by_what_it_stands_for():
    shown = [pictogram for pictogram in PICTOGRAMS if pictogram.shows]
    assert len(shown) > 30
    assert not [p.name for p in shown if p.name in p.shows]
    assert not [p.name for p in shown if side_words(p.shows)]


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
    own = {"side": "Put it {side}", "neutral": "Put it anywhere"}
    item = replace(of_category(suite, "emotion"), wordings=own)
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
    assert not [found for found in validate_suite(suite.folder).findings if found.severity == "error"]


@pytest.mark.parametrize(
    "wordings",
    ["named", {"nmaed": "x"}, {"named": ""}, {"named": 3}, {"side": "the left one"}, {"named": "the {side} one"}],
)
def test_a_suite_with_wordings_that_mean_nothing_is_refused(wordings, suite):
    record = of_category(suite, "emotion").to_json() | {"wordings": wordings}
    assert [finding.rule for finding in check_record(record, "line 1")] == ["E02"]


def test_wordings_change_no_suites_identity(suite):
    assert suite.content_sha256_of(replace(item, wordings={}) for item in suite.items) == suite.content_sha256


def test_no_plainer_words_name_a_side_though_a_right_triangle_is_drawn(tmp_path):
    drawn = build_suite(tmp_path / "color", ["color"], 60)
    triangles = [i for i in drawn.items if i.gen[i.correct_side]["outline"] == "right triangle"]
    assert triangles
    assert not [i for i in drawn.items if side_words(i.wordings.get("named", ""))]
    assert not [i for i in triangles if "named" in i.wordings]
