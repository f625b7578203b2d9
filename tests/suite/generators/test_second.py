"""Version 2 of the suite: version 1's questions on pictures that recur less, and version 1 as it ever was."""

import json
from itertools import islice
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.hashing import sha256_json, sha256_text
from probe_kit.suite import build_suite
from probe_kit.suite.generators import GENERATORS, generators_of
from probe_kit.suite.generators.couples import draw_couples
from probe_kit.suite.generators.drawing.palette import COLORS, INK_CONTRAST, lightness
from probe_kit.suite.generators.second import SECOND
from probe_kit.suite.generators.twins import draw_twins

CHANGED = [generator.category for generator in SECOND]
FIRST_VERSION = "35f2bb0296b9af60b779c66ea2b7048e4f99d961c565b5a62d0efea9cfa72dae"
"""sha256 of what the first three couples of every category of version 1 are drawn from and asked, and how."""


def drawn_from(version: int) -> str:
    """Without pixels, which other versions of Pillow may shade otherwise."""
    twins = [one for name in generators_of(version) for one in draw_twins(name, 3, 0, version)]
    return sha256_json([[item.gen, item.instruction, item.correct_side] for one in twins for item in one.items])


def tiles(category: str, count: int = 60) -> list[Any]:
    couples = islice(draw_couples(generators_of(2)[category], seed=0), count)
    return [tile for couple in couples for tile in (couple.left_tile, couple.right_tile)]


def test_version_1_is_what_it_ever_was() -> None:
    assert drawn_from(1) == FIRST_VERSION


def test_version_2_asks_the_questions_of_version_1_in_its_words() -> None:
    assert set(generators_of(2)) == set(GENERATORS)
    for category, generator in generators_of(2).items():
        assert generator.pairs == GENERATORS[category].pairs


@pytest.mark.slow
@pytest.mark.parametrize("category", CHANGED)
def test_pictures_stay_on_their_tile_and_stand_out(category: str) -> None:
    for tile in tiles(category):
        pixels = np.asarray(tile.draw())
        border = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
        assert (border == tile.background).all()
        assert abs(lightness(tile.ink) - lightness(tile.background)) >= INK_CONTRAST


@pytest.mark.parametrize("category", CHANGED)
def test_backgrounds_are_far_more_colourful_than_in_version_1(category: str) -> None:
    def chroma(version: int) -> float:
        couples = islice(draw_couples(generators_of(version)[category], seed=0), 40)
        found = [tile.background for couple in couples for tile in (couple.left_tile, couple.right_tile)]
        return float(np.mean([max(color) - min(color) for color in found]))

    assert chroma(2) > 4 * chroma(1)


def test_no_background_has_a_colour_that_is_asked_for() -> None:
    def nearest(color: tuple[int, int, int]) -> str:
        return min(COLORS, key=lambda name: float(np.abs(np.subtract(COLORS[name], color)).sum()))

    for couple in islice(draw_couples(generators_of(2)["color"], seed=0), 60):
        asked = {couple.left.name, couple.right.name}
        assert not {nearest(couple.left_tile.background), nearest(couple.right_tile.background)} & asked


def test_the_version_is_part_of_the_identity_and_both_are_built_again_equal(tmp_path: Any) -> None:
    one, two, again = (
        build_suite(tmp_path / name, ["color", "counting"], 4, version=version)
        for name, version in (("one", 1), ("two", 2), ("again", 2))
    )
    assert (one.identity.split("#")[0], two.identity.split("#")[0]) == ("a2a-embedded@1.0.0", "a2a-embedded@2.0.0")
    assert json.loads((two.folder / "suite.json").read_text(encoding="utf-8"))["version"] == "2.0.0"
    assert two.content_sha256 == again.content_sha256 != one.content_sha256
    assert not {item.item_id for item in one.items} & {item.item_id for item in two.items}
    assert sha256_text(str([item.instruction for item in one.items])) == sha256_text(
        str([item.instruction for item in two.items])
    )


def test_other_versions_are_refused(tmp_path: Any) -> None:
    with pytest.raises(UsageError, match="suite version 3; expected 1 or 2"):
        build_suite(tmp_path / "suite", ["color"], 2, version=3)
    assert list(tmp_path.iterdir()) == []
