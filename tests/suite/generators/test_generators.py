"""What every embedded category promises, and the rules of each."""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from probe_kit.suite.generators import GENERATORS, vocabulary
from probe_kit.suite.generators.couples import Couple, draw_couples
from probe_kit.suite.generators.glyphs import GLYPHS
from probe_kit.suite.generators.palette import INK_CONTRAST, lightness

THUMBNAILS = Path(__file__).with_name("thumbnails.png")


def couples(category: str, count: int = 60) -> list[Couple]:
    return list(islice(draw_couples(GENERATORS[category], seed=0), count))


def tiles(category: str, count: int = 60) -> list[Any]:
    return [tile for couple in couples(category, count) for tile in (couple.left_tile, couple.right_tile)]


@pytest.mark.parametrize("category", list(GENERATORS))
def test_equal_tiles_give_equal_pixels(category: str) -> None:
    assert [tile.draw().tobytes() for tile in tiles(category, 3)] == [
        tile.draw().tobytes() for tile in tiles(category, 3)
    ]


@pytest.mark.parametrize("category", list(GENERATORS))
def test_there_are_at_least_150_items_without_repeating_a_question(category: str) -> None:
    questions = {
        (asked.phrase, other.name) for a, b in GENERATORS[category].pairs for asked, other in ((a, b), (b, a))
    }
    assert len(questions) == 2 * len(GENERATORS[category].pairs)
    assert len(questions) >= (110 if category == "color" else 150)


@pytest.mark.parametrize("category", list(GENERATORS))
def test_a_tile_is_256_pixels_square_and_nothing_touches_its_border(category: str) -> None:
    for tile in tiles(category):
        pixels = np.asarray(tile.draw())
        assert pixels.shape == (256, 256, 3)
        border = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
        assert (border == tile.background).all()


@pytest.mark.parametrize("category", list(GENERATORS))
def test_ink_stands_out_from_the_background(category: str) -> None:
    for tile in tiles(category):
        assert abs(lightness(tile.ink) - lightness(tile.background)) >= INK_CONTRAST


@pytest.mark.parametrize("category", list(GENERATORS))
def test_nuisances_are_drawn_for_each_tile_on_its_own(category: str) -> None:
    both = [(couple.left_tile, couple.right_tile) for couple in couples(category)]
    backgrounds = np.array([[lightness(tile.background) for tile in pair] for pair in both])
    assert abs(np.corrcoef(backgrounds.T)[0, 1]) < 0.4
    assert len({tuple(tile.background) for pair in both for tile in pair}) > 100


def test_the_vocabulary_holds_every_word_and_no_side() -> None:
    words = vocabulary()
    assert words == sorted(set(words))
    assert {"put", "the", "cube", "on", "gray", "parallelogram", "picture", "with", "nine", "leaves"} <= set(words)
    assert not {"left", "right"} & set(words)


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
    asked = {concept.name for pair in GENERATORS["shape"].pairs for concept in pair}
    assert len(asked) == 14
    assert "right triangle" not in asked


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
        for number, one in enumerate(tile.placements):
            assert max(abs(one.x), abs(one.y)) + one.scale < 1
            for other in tile.placements[number + 1 :]:
                assert np.hypot(one.x - other.x, one.y - other.y) > one.scale + other.scale


def test_glyphs_are_at_least_a_fifth_of_the_tile() -> None:
    assert min(placement.scale for tile in tiles("counting", 120) for placement in tile.placements) >= 0.2


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
