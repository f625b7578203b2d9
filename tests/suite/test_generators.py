"""What every embedded category promises, and the rules of each."""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import fields
from itertools import combinations, islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from probe_kit.hashing import sha256_json
from probe_kit.suite import CATEGORIES, Item, Side, Suite, build_suite
from probe_kit.suite.build import draw_twins
from probe_kit.suite.generators import GENERATORS, Concept, vocabulary
from probe_kit.suite.generators.attribute import GRADABLES
from probe_kit.suite.generators.counting import GLYPHS
from probe_kit.suite.generators.drawing import (
    COLORS,
    INK_CONTRAST,
    Canvas,
    Placement,
    Points,
    background_for,
    color_icon,
    jitter,
    lightness,
    mask_icon,
)
from probe_kit.suite.generators.drawing import FOLDER as ART
from probe_kit.suite.generators.generator import Couple, draw_couples, visiting_order
from probe_kit.suite.generators.living_world import CREATURES, THINGS
from probe_kit.suite.generators.public_info import PICTOGRAMS
from probe_kit.suite.generators.shapes import OUTLINES, mirror_overlap
from probe_kit.suite.generators.state import TWO_STATES
from probe_kit.suite.generators.traffic import ROAD_SIGN_ICONS, ROAD_SIGNS
from probe_kit.suite.items import MOST_WORDS, instruction_for, side_words

THUMBNAILS = Path(__file__).with_name("thumbnails.png")
CATEGORY_PARAMETERS = [pytest.param(name, marks=[pytest.mark.slow] * (name == "symmetry")) for name in GENERATORS]
"""Tiles of symmetry take a second to draw."""


def couples(category: str, count: int = 60) -> list[Couple]:
    return list(islice(draw_couples(GENERATORS[category], seed=0), count))


def tiles(category: str, count: int = 60) -> list[Any]:
    return [tile for couple in couples(category, count) for tile in (couple.left_tile, couple.right_tile)]


@pytest.mark.slow
@pytest.mark.parametrize("category", list(GENERATORS))
def test_equal_tiles_give_equal_pixels(category: str) -> None:
    assert [tile.draw().tobytes() for tile in tiles(category, 3)] == [
        tile.draw().tobytes() for tile in tiles(category, 3)
    ]


# How many phrases against how many others there are: few where a category asks one rule of many pictures.
FEW_QUESTIONS = {"emotion": 54, "attribute": 36, "state": 36, "symmetry": 2, "color": 110}


@pytest.mark.parametrize("category", list(GENERATORS))
def test_there_are_at_least_150_items_without_repeating_a_question(category: str) -> None:
    questions = {
        (asked_concept.phrase, other.name)
        for a, b in GENERATORS[category].pairs
        for asked_concept, other in ((a, b), (b, a))
    }
    assert len(set(GENERATORS[category].pairs)) == len(GENERATORS[category].pairs)
    if category in FEW_QUESTIONS:
        assert len(questions) == FEW_QUESTIONS[category]
    else:
        assert len(questions) >= 150


@pytest.mark.slow
@pytest.mark.parametrize("category", list(GENERATORS))
def test_a_tile_is_256_pixels_square_and_nothing_touches_its_border(category: str) -> None:
    for tile in tiles(category, 8):
        pixels = np.asarray(tile.draw())
        assert pixels.shape == (256, 256, 3)
        border = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
        assert (border == tile.background).all()


@pytest.mark.parametrize("category", CATEGORY_PARAMETERS)
def test_ink_stands_out_from_the_background(category: str) -> None:
    for tile in tiles(category):
        assert abs(lightness(tile.ink) - lightness(tile.background)) >= INK_CONTRAST


@pytest.mark.parametrize("category", CATEGORY_PARAMETERS)
def test_nuisances_are_drawn_for_each_tile_on_its_own(category: str) -> None:
    both = [(couple.left_tile, couple.right_tile) for couple in couples(category)]
    backgrounds = np.array([[lightness(tile.background) for tile in pair] for pair in both])
    assert abs(np.corrcoef(backgrounds.T)[0, 1]) < 0.4
    assert len({tuple(tile.background) for pair in both for tile in pair}) > 100


def test_the_vocabulary_holds_every_word_and_no_side() -> None:
    words = vocabulary()
    assert words == sorted(set(words))
    assert {"put", "the", "cube", "on", "gray", "parallelogram", "picture", "with", "nine", "leaves"} <= set(words)
    assert {"clock", "4:30", "wi-fi", "speed", "50", "symmetric", "angrier", "unripe", "fox"} <= set(words)
    assert not {"left", "right"} & set(words)
    assert all(word == word.lower() for word in words)


# -- color -------------------------------------------------------------------------------------------


def test_color_repeats_the_outline_in_half_of_the_pairs() -> None:
    same = [couple.left_tile.outline == couple.right_tile.outline for couple in couples("color", 200)]
    assert 0.4 < np.mean(same) < 0.6


def test_color_covers_all_eleven_terms_and_fifteen_outlines() -> None:
    drawn = tiles("color", 150)
    assert len({tile.color for tile in drawn}) == 11
    assert len({tile.outline for tile in drawn}) == 15


# -- shape -------------------------------------------------------------------------------------------


def test_shape_never_pairs_outlines_that_look_alike() -> None:
    paired = {frozenset((a.name, b.name)) for a, b in GENERATORS["shape"].pairs}
    assert frozenset(("circle", "star")) in paired
    for alike in (("circle", "oval"), ("square", "diamond"), ("pentagon", "hexagon"), ("trapezoid", "rectangle")):
        assert frozenset(alike) not in paired


def test_shape_asks_for_fourteen_outlines_and_not_for_the_right_triangle() -> None:
    outlines = {concept.name for pair in GENERATORS["shape"].pairs for concept in pair}
    assert len(outlines) == 14
    assert "right triangle" not in outlines


def test_the_colour_and_style_of_a_shape_say_nothing_about_it() -> None:
    drawn = tiles("shape", 200)
    assert len({tile.color for tile in drawn}) == 11
    assert 0.2 < np.mean([tile.style == "hollow" for tile in drawn]) < 0.4


# -- counting ----------------------------------------------------------------------------------------


def test_counting_draws_as_many_glyphs_as_it_says_and_the_same_kind_on_both_sides() -> None:
    for couple in couples("counting"):
        assert len(couple.left_tile.placements) == couple.left.number
        assert len(couple.right_tile.placements) == couple.right.number
        assert couple.left_tile.glyph == couple.right_tile.glyph
        assert 1 <= abs(couple.left.number - couple.right.number) <= 3


def test_glyphs_do_not_overlap_and_stay_on_the_tile() -> None:
    for tile in tiles("counting", 120):
        for number, placement in enumerate(tile.placements):
            assert max(abs(placement.x), abs(placement.y)) + placement.scale < 1
            for other in tile.placements[number + 1 :]:
                assert np.hypot(placement.x - other.x, placement.y - other.y) > placement.scale + other.scale


def test_glyphs_are_at_least_a_fifth_of_the_tile() -> None:
    assert min(placement.scale for tile in tiles("counting", 120) for placement in tile.placements) >= 0.2


@pytest.mark.slow
def test_neither_ink_nor_glyph_size_gives_the_number_away() -> None:
    def spread(values: Sequence[float]) -> float:
        return max(values) / min(values)

    drawn = tiles("counting", 400)
    for number in (1, 2, 3):
        assert spread([t.placements[0].scale for t in drawn if len(t.placements) == number]) > 1.6
    alike = [t for t in drawn if 0.2 <= t.placements[0].scale <= 0.23]
    assert {len(tile.placements) for tile in alike} == set(range(1, 10))


def test_plurals_are_real_english() -> None:
    assert GLYPHS["leaf"].counted("three") == "three leaves"
    assert GLYPHS["fish"].counted("two") == "two fish"
    assert GLYPHS["butterfly"].counted("nine") == "nine butterflies"
    assert GLYPHS["apple"].counted("one") == "one apple"


# -- every category ----------------------------------------------------------------------------------


def test_the_suite_has_all_categories_but_celebrity() -> None:
    assert list(GENERATORS) == [slug for slug in CATEGORIES if slug != "celebrity"]


@pytest.mark.parametrize("category", list(GENERATORS))
def test_no_phrase_is_too_long_or_names_a_side(category: str) -> None:
    for concept in {concept for pair in GENERATORS[category].pairs for concept in pair}:
        instruction = instruction_for(concept.phrase, "the")
        assert len(instruction.split()) <= MOST_WORDS
        assert not side_words(instruction)


# -- emotion -----------------------------------------------------------------------------------------


def test_comparisons_show_one_feeling_at_two_strengths() -> None:
    compared = [c for c in couples("emotion", 200) if c.left.polarity != "none"]
    assert len({c.left.emotion for c in compared}) == 6
    for couple in compared:
        assert couple.left_tile.emotion == couple.right_tile.emotion
        strength = {
            couple.left.polarity: couple.left_tile.strength,
            couple.right.polarity: couple.right_tile.strength,
        }
        assert strength == {"pos": 1.0, "neg": 0.3}


def test_faces_vary_in_whatever_is_no_feeling() -> None:
    drawn = tiles("emotion", 200)
    assert len({tile.ink for tile in drawn}) == len({tile.hair for tile in drawn}) == 6
    assert 0.1 < np.mean([tile.glasses for tile in drawn]) < 0.3


# -- attribute and state -----------------------------------------------------------------------------


def test_there_are_at_least_sixteen_kinds_of_attributes_and_states() -> None:
    assert len(GRADABLES) >= 16
    assert len(TWO_STATES) >= 16


def test_levels_are_a_good_way_apart_and_in_the_order_that_is_asked_for() -> None:
    for couple in couples("attribute", 200):
        level = {couple.left.polarity: couple.left_tile.level, couple.right.polarity: couple.right_tile.level}
        assert level["pos"] - level["neg"] >= 0.44
        assert 0 <= level["neg"] < level["pos"] <= 1


@pytest.mark.slow
def test_a_smaller_scale_never_makes_up_for_a_larger_level() -> None:
    """What is bigger must cover more of its tile, whatever its placement."""
    for couple in couples("attribute", 200):
        if couple.left_tile.more == "bigger ball":
            bigger, smaller = sorted((couple.left_tile, couple.right_tile), key=lambda tile: -tile.level)
            ink = [(np.asarray(tile.draw()) != tile.background).any(axis=2).sum() for tile in (bigger, smaller)]
            assert ink[0] > 1.3 * ink[1]


@pytest.mark.slow
def test_the_two_states_of_a_thing_look_different() -> None:
    for drawing in TWO_STATES:
        drawn = []
        for first in (True, False):
            canvas = Canvas((220, 220, 220))
            drawing.draw(canvas.pen(Placement(0.85, 0, 0, 0, False)), first, COLORS["blue"])
            drawn.append(np.asarray(canvas.picture().resize((48, 48)), np.float64))
        assert np.abs(drawn[0] - drawn[1]).mean() > 3, drawing.first


# -- symmetry ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_shapes_are_what_they_are_called_when_measured() -> None:
    for couple in couples("symmetry", 60):
        for concept, tile in ((couple.left, couple.left_tile), (couple.right, couple.right_tile)):
            overlap = mirror_overlap(tile.one_side, tile.other_side)
            assert overlap >= 0.93 if concept.name == "symmetric" else overlap <= 0.80


@pytest.mark.slow
def test_both_kinds_of_shapes_have_the_same_widths_on_either_side() -> None:
    for tile in tiles("symmetry"):
        assert sorted(tile.one_side) == sorted(tile.other_side)


# -- time --------------------------------------------------------------------------------------------


def test_two_clocks_differ_in_one_hand_or_in_which_hand_is_which() -> None:
    for first, other in GENERATORS["time"].pairs:
        exchanged = first.minute == 5 * (other.hour % 12) and other.minute == 5 * (first.hour % 12)
        assert (first.hour == other.hour) + (first.minute == other.minute) + exchanged >= 1


def test_hands_never_hide_each_other() -> None:
    for tile in tiles("time"):
        apart = abs(30 * (tile.hour % 12) + tile.minute / 2 - 6 * tile.minute) % 360
        assert min(apart, 360 - apart) >= 22


# -- signs -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("category", "least"), [("public-info", 34), ("traffic", 31)])
def test_there_are_enough_signs(category: str, least: int) -> None:
    assert len({concept.name for pair in GENERATORS[category].pairs for concept in pair}) >= least


def test_prohibitions_meet_prohibitions_half_of_the_time() -> None:
    kinds = {pictogram.name: pictogram.forbidden for pictogram in PICTOGRAMS}
    met = [kinds[a.name] + kinds[b.name] for a, b in GENERATORS["public-info"].pairs]
    assert met.count(2) == met.count(1) == 28


def test_road_signs_meet_their_own_family_half_of_the_time() -> None:
    pairs = GENERATORS["traffic"].pairs
    assert np.mean([ROAD_SIGNS[a.name].family == ROAD_SIGNS[b.name].family for a, b in pairs]) == 0.5


# -- living world ------------------------------------------------------------------------------------


def test_there_are_many_creatures_and_things() -> None:
    assert len(CREATURES) >= 80
    assert len(THINGS) >= 21


def test_a_whole_animal_never_stands_beside_a_face() -> None:
    view = {creature.name: creature.view for creature in CREATURES}
    for first, other in GENERATORS["living-world"].pairs:
        if first.name in view and other.name in view:
            assert view[first.name] == view[other.name]


def test_every_icon_is_in_the_sheets_that_are_shipped() -> None:
    for name in (*(creature.icon for creature in CREATURES), *THINGS):
        assert color_icon(name).getchannel("A").getextrema()[1] > 250
    for name in (*(pictogram.icon for pictogram in PICTOGRAMS), *ROAD_SIGN_ICONS):
        assert mask_icon(name).getextrema()[1] > 250


def test_art_comes_with_its_licences_and_checksums() -> None:
    notice = (ART / "NOTICE.md").read_text(encoding="utf-8")
    for sheet in ("fluent.png", "material.png"):
        assert hashlib.sha256((ART / sheet).read_bytes()).hexdigest() in notice
    assert "Microsoft Corporation" in (ART / "LICENSE-fluent.txt").read_text(encoding="utf-8")
    assert "Apache License" in (ART / "LICENSE-material.txt").read_text(encoding="utf-8")


# -- all pictures ------------------------------------------------------------------------------------


def thumbnail_sheet() -> Image.Image:
    """The first eight tiles of every category in a row each, 32 pixels and gray."""
    sheet = Image.new("L", (8 * 32, len(GENERATORS) * 32))
    for row, category in enumerate(GENERATORS):
        for column, tile in enumerate(tiles(category, 4)):
            sheet.paste(tile.draw().convert("L").resize((32, 32)), (column * 32, row * 32))
    return sheet


def test_pictures_are_those_of_this_suite_version(tmp_path: Path) -> None:
    """Other versions of Pillow may shade an edge differently; another picture needs another SUITE_VERSION."""
    drawn = thumbnail_sheet()
    drawn.save(tmp_path / "thumbnails.png")
    with Image.open(THUMBNAILS) as expected:
        difference = np.abs(np.asarray(drawn, np.float64) - np.asarray(expected, np.float64))
    by_tile = difference.reshape(len(GENERATORS), 32, 8, 32).mean(axis=(1, 3))
    assert by_tile.max() <= 2, (
        f"a picture changed: raise SUITE_VERSION, then copy {tmp_path / 'thumbnails.png'} to {THUMBNAILS}"
    )


CONCEPTS = [Concept(name, name) for name in "abcdefg"]
PAIRS = tuple(combinations(CONCEPTS, 2))


def visited(count: int, seed: int = 0) -> list[tuple[str, str]]:
    order = visiting_order(PAIRS, np.random.default_rng(seed))
    return [(left.name, right.name) for left, right in islice(order, count)]


def test_all_pairs_are_visited_before_any_is_visited_again() -> None:
    rounds = visited(2 * len(PAIRS))
    for once in (rounds[: len(PAIRS)], rounds[len(PAIRS) :]):
        assert {frozenset(pair) for pair in once} == {frozenset((a.name, b.name)) for a, b in PAIRS}


def test_the_second_round_has_another_order() -> None:
    rounds = visited(2 * len(PAIRS))
    assert [set(pair) for pair in rounds[: len(PAIRS)]] != [set(pair) for pair in rounds[len(PAIRS) :]]


def test_at_every_point_each_concept_has_lain_left_about_as_often_as_right() -> None:
    lean: Counter[str] = Counter()
    for left, right in visited(500):
        lean.update({left: 1, right: -1})
        assert max(map(abs, lean.values())) <= 3


def test_the_order_depends_on_the_seed() -> None:
    assert visited(20, seed=0) != visited(20, seed=1)


def area(points: Points) -> float:
    x, y = points.T
    return abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))) / 2


def test_there_are_fifteen_outlines() -> None:
    assert len(OUTLINES) == 15


@pytest.mark.parametrize("name", list(OUTLINES))
def test_all_outlines_have_the_same_area_and_are_centred(name: str) -> None:
    points = OUTLINES[name]
    assert area(points) == pytest.approx(area(OUTLINES["square"]))
    np.testing.assert_allclose(points.min(axis=0), -points.max(axis=0), atol=1e-9)


def test_outlines_cannot_be_changed_by_accident() -> None:
    with pytest.raises(ValueError, match="read-only"):
        OUTLINES["star"][0] = 0


@pytest.mark.parametrize("name", ["black", "white", "gray"])
def test_a_colour_without_hue_stays_without_hue(name: str) -> None:
    rng = np.random.default_rng(0)
    assert all(len(set(jitter(COLORS[name], rng))) == 1 for _ in range(200))


def test_a_shade_stays_nearest_to_its_own_name() -> None:
    rng = np.random.default_rng(0)
    terms = np.array(list(COLORS.values()), np.float64)
    for number, color in enumerate(COLORS.values()):
        shades = np.array([jitter(color, rng) for _ in range(200)])
        nearest = np.linalg.norm(shades[:, None] - terms, axis=2).argmin(axis=1)
        assert (nearest == number).all()


def test_shades_differ() -> None:
    rng = np.random.default_rng(0)
    assert len({jitter(COLORS["red"], rng) for _ in range(100)}) > 80


def test_backgrounds_are_pale_whatever_the_ink() -> None:
    rng = np.random.default_rng(0)
    for ink in COLORS.values():
        backgrounds = np.array([background_for(ink, rng) for _ in range(100)])
        assert backgrounds.min() >= 150 - 12
        assert np.ptp(backgrounds, axis=1).max() <= 2 * 12


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


@pytest.mark.slow
def test_every_concept_is_target_as_often_as_distractor(embedded: Suite) -> None:
    targets = Counter((item.category, item.target_concept) for item in embedded.items)
    assert targets == Counter((item.category, item.distractor_concept) for item in embedded.items)


@pytest.mark.slow
@pytest.mark.parametrize("category", list(GENERATORS))
def test_each_original_layout_has_as_many_answers_left_as_right(embedded: Suite, category: str) -> None:
    sides = Counter(item.correct_side for item in embedded.items if item.category == category)
    assert sides["left"] == sides["right"] == 10


@pytest.mark.slow
def test_no_phrase_leans_to_a_side_in_the_original_layout(embedded: Suite) -> None:
    lean: Counter[str] = Counter()
    for item in embedded.items:
        lean[item.object_phrase] += 1 if item.correct_side == "left" else -1
    assert max(map(abs, lean.values())) <= 2


@pytest.mark.slow
def test_which_twin_comes_first_says_nothing_about_its_side(embedded: Suite) -> None:
    left_first = np.mean([first.correct_side == "left" for first, _ in twins_of(embedded)])
    assert abs(left_first - 0.5) < 3 * np.sqrt(0.25 / len(twins_of(embedded)))


@pytest.mark.slow
def test_instructions_name_no_side_and_follow_one_form(embedded: Suite) -> None:
    for item in embedded.items:
        assert item.instruction == f"Put the cube on the {item.object_phrase}"
        assert not {"left", "right", "first", "second", "centre", "middle"} & set(item.instruction.lower().split())


@pytest.mark.slow
def test_an_item_says_where_its_pictures_come_from_and_how_they_were_drawn(embedded: Suite) -> None:
    item = embedded.select(["color"], 2).items[0]
    assert item.source["benchmark"] == "a2a-embedded"
    assert (item.transfer_type, item.license, item.attribution) == ("procedural", "Apache-2.0", "probe_kit")
    assert item.gen["generator"] == item.category
    assert set(item.gen["left"]) == set(item.gen["right"])


@pytest.mark.slow
def test_every_field_has_one_type_so_that_tables_can_be_inferred(embedded: Suite) -> None:
    for field in fields(Item):
        assert len({type(getattr(item, field.name)) for item in embedded.items}) == 1
        assert all(getattr(item, field.name) is not None for item in embedded.items)


COLOURFUL = ("attribute", "color", "shape", "traffic")
DRAWN_FROM = "091f29c53352e411b1b0b3458a1487bd2be7256957eef7daecb189dc284b8872"
"""sha256 of what the first three couples of every category are drawn from and asked, and of their sides."""


def tiles_of(category: str, count: int = 60) -> list[Any]:
    couples = islice(draw_couples(GENERATORS[category], seed=0), count)
    return [tile for couple in couples for tile in (couple.left_tile, couple.right_tile)]


def test_the_items_are_those_of_this_suite_version() -> None:
    """Parameters instead of pixels, which other versions of Pillow may shade otherwise."""
    twins = [pair for name in GENERATORS for pair in draw_twins(name, 3, 0)]
    drawn = [[item.gen, item.instruction, item.correct_side] for pair in twins for item in pair.items]
    assert sha256_json(drawn) == DRAWN_FROM


@pytest.mark.slow
@pytest.mark.parametrize("category", COLOURFUL)
def test_pictures_stay_on_their_tile_and_stand_out(category: str) -> None:
    for tile in tiles_of(category):
        pixels = np.asarray(tile.draw())
        border = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
        assert (border == tile.background).all()
        assert abs(lightness(tile.ink) - lightness(tile.background)) >= INK_CONTRAST


@pytest.mark.parametrize("category", COLOURFUL)
def test_backgrounds_are_far_more_colourful_than_pale_ones(category: str) -> None:
    def chroma(background: Callable[[Any], tuple[int, int, int]]) -> float:
        return float(np.mean([max(color) - min(color) for color in map(background, tiles_of(category, 40))]))

    rng = np.random.default_rng(0)
    assert chroma(lambda tile: tile.background) > 4 * chroma(lambda tile: background_for(tile.ink, rng))


def test_no_background_has_a_colour_that_is_asked_for() -> None:
    def nearest(color: tuple[int, int, int]) -> str:
        return min(COLORS, key=lambda name: float(np.abs(np.subtract(COLORS[name], color)).sum()))

    for couple in islice(draw_couples(GENERATORS["color"], seed=0), 60):
        met = {couple.left.name, couple.right.name}
        assert not {nearest(couple.left_tile.background), nearest(couple.right_tile.background)} & met


def test_a_suite_is_built_again_equal_and_names_its_version(tmp_path: Path) -> None:
    first, again = (build_suite(tmp_path / name, ["color", "counting"], 4) for name in ("first", "again"))
    assert first.identity == again.identity
    assert first.identity.startswith("a2a-embedded@2.0.0#")
