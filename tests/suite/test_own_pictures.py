from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image, ImageDraw

from probe_kit.errors import SuiteError, UsageError
from probe_kit.suite import PicturePair, load_suite, suite_from_pictures, validate_suite

TERMS = {"name": "mine", "license": "CC0-1.0", "attribution": "nobody"}
COLOURS = ("red", "green", "blue", "orange", "purple", "brown")


@pytest.fixture
def discs(tmp_path: Path) -> dict[str, Path]:
    """A disc of each colour, wider than high, as a photograph would be."""
    paths = {}
    for number, colour in enumerate(COLOURS):
        image = Image.new("RGB", (320, 200 + number), "white")
        ImageDraw.Draw(image).ellipse((60 + 4 * number, 20, 220, 180), fill=colour)
        image.save(path := tmp_path / f"{colour}.png")
        paths[colour] = path
    return paths


def pairs_of(discs: dict[str, Path]) -> list[PicturePair]:
    return [
        PicturePair("color", f"{one} shape", discs[one], f"{other} shape", discs[other])
        for one, other in zip(COLOURS[::2], COLOURS[1::2], strict=True)
    ]


def test_every_pair_is_asked_both_ways_and_the_suite_is_valid(discs: dict[str, Path], tmp_path: Path) -> None:
    suite = suite_from_pictures(tmp_path / "mine", pairs_of(discs), **TERMS)
    report = validate_suite(suite.folder)
    assert report.ok, report.to_text()
    assert {finding.rule for finding in report.warnings} == {"W04", "W09"}  # colours tell discs apart
    assert load_suite(suite.folder).identity == suite.identity
    assert [item.instruction for item in suite.items[:2]] == [
        "Put the cube on the red shape",
        "Put the cube on the green shape",
    ]
    for item in suite.items:
        colour = item.object_phrase.split()[0]
        shown = Image.open(item.picture(item.correct_side)).convert("RGB")
        assert shown.size == (320, 320)
        assert shown.getpixel((140, 160)) == Image.new("RGB", (1, 1), colour).getpixel((0, 0))


def test_the_first_picture_lies_left_and_right_in_turn(discs: dict[str, Path], tmp_path: Path) -> None:
    suite = suite_from_pictures(tmp_path / "mine", pairs_of(discs), **TERMS)
    side_of = {item.object_phrase: item.correct_side for item in suite.items}
    assert [side_of[f"{colour} shape"] for colour in COLOURS[::2]] == ["left", "right", "left"]


def test_pairs_that_share_a_picture_share_a_group(discs: dict[str, Path], tmp_path: Path) -> None:
    chain = [
        PicturePair("color", "red shape", discs["red"], "green shape", discs["green"]),
        PicturePair("color", "green shape", discs["green"], "blue shape", discs["blue"]),
        PicturePair("color", "brown shape", discs["brown"], "orange shape", discs["orange"]),
    ]
    suite = suite_from_pictures(tmp_path / "mine", chain, **TERMS)
    groups = [item.group_id for item in suite.items]
    assert groups[0] == groups[1] == groups[2] == groups[3] != groups[4] == groups[5]


def test_the_same_pictures_give_the_same_suite_wherever_they_lie(discs: dict[str, Path], tmp_path: Path) -> None:
    one = suite_from_pictures(tmp_path / "one", pairs_of(discs), **TERMS)
    other = suite_from_pictures(tmp_path / "other", pairs_of(discs), **TERMS)
    assert one.identity == other.identity


def test_bad_pairs_are_refused_and_nothing_is_written(discs: dict[str, Path], tmp_path: Path) -> None:
    red, green = discs["red"], discs["green"]
    pair = PicturePair("color", "red shape", red, "green shape", green)
    turned = PicturePair("color", "green shape", green, "red shape", red)
    with pytest.raises(UsageError, match="at least one"):
        suite_from_pictures(tmp_path / "mine", [], **TERMS)
    with pytest.raises(UsageError, match="twice"):
        suite_from_pictures(tmp_path / "mine", [pair, turned], **TERMS)
    for name in ("mean", "all", "Colour", "a b", "-a", ""):
        with pytest.raises(UsageError, match="cannot name a category"):
            suite_from_pictures(tmp_path / "mine", [PicturePair(name, "a", red, "b", green)], **TERMS)
    with pytest.raises(SuiteError, match="names a side"):
        suite_from_pictures(tmp_path / "mine", [PicturePair("color", "left one", red, "b", green)], **TERMS)
    missing = PicturePair("color", "red shape", red, "green shape", tmp_path / "nothing.png")
    with pytest.raises(SuiteError, match=r"nothing\.png"):
        suite_from_pictures(tmp_path / "mine", [missing], **TERMS)
    assert not (tmp_path / "mine").exists()


def test_a_category_of_ones_own_is_a_row_and_a_misspelt_one_is_pointed_out(
    discs: dict[str, Path], tmp_path: Path
) -> None:
    pair = PicturePair("ripe-fruit", "red one", discs["red"], "green one", discs["green"])
    suite = suite_from_pictures(tmp_path / "mine", [pair], **TERMS)
    assert suite.categories == ("ripe-fruit",)
    assert load_suite(suite.folder).items == suite.items
    assert "Ripe fruit" in validate_suite(suite.folder).to_text()
    alone = suite_from_pictures(tmp_path / "alone", [replace(pair, category="colour")], **TERMS)
    for own in (suite, alone):
        report = validate_suite(own.folder)
        assert report.missing == ()
        assert "Not in this suite" not in report.to_text()
        assert not [finding for finding in report.warnings if finding.rule == "W08"]
    known = PicturePair("shape", "red disc", discs["red"], "green disc", discs["green"])
    both = [replace(pair, category="colour"), known]
    misspelt = suite_from_pictures(tmp_path / "other", both, **TERMS)
    assert [str(f) for f in validate_suite(misspelt.folder).warnings if f.rule == "W08"] == [
        "W08 colour: is none of the paper; if 'color' is meant, rename it"
    ]


def test_nearly_the_same_pictures_in_different_groups_are_said_once(
    tmp_path: Path, discs: dict[str, Path]
) -> None:
    again = {}
    for colour in ("red", "green"):
        Image.open(discs[colour]).save(path := tmp_path / f"{colour}.jpg", quality=80)
        again[colour] = path
    pairs = [
        PicturePair("color", "red one", discs["red"], "green one", discs["green"]),
        PicturePair("color", "red two", again["red"], "green two", again["green"]),
    ]
    suite = suite_from_pictures(tmp_path / "mine", pairs, **TERMS)
    lines = [str(finding) for finding in validate_suite(suite.folder).warnings if finding.rule == "W03"]
    assert lines
    assert len(lines) == len(set(lines))
