"""Backgrounds recur little from picture to picture, and the drawn items of this version are fixed."""

from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.hashing import sha256_json
from probe_kit.suite import build_suite
from probe_kit.suite.build import draw_twins
from probe_kit.suite.generators import GENERATORS
from probe_kit.suite.generators.drawing import COLORS, INK_CONTRAST, background_for, lightness
from probe_kit.suite.generators.generator import draw_couples

COLOURFUL = ("attribute", "color", "shape", "traffic")
DRAWN_FROM = "091f29c53352e411b1b0b3458a1487bd2be7256957eef7daecb189dc284b8872"
"""sha256 of what the first three couples of every category are drawn from and asked, and of their sides."""


def tiles(category: str, count: int = 60) -> list[Any]:
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
    for tile in tiles(category):
        pixels = np.asarray(tile.draw())
        border = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
        assert (border == tile.background).all()
        assert abs(lightness(tile.ink) - lightness(tile.background)) >= INK_CONTRAST


@pytest.mark.parametrize("category", COLOURFUL)
def test_backgrounds_are_far_more_colourful_than_pale_ones(category: str) -> None:
    def chroma(background: Callable[[Any], tuple[int, int, int]]) -> float:
        return float(np.mean([max(color) - min(color) for color in map(background, tiles(category, 40))]))

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
