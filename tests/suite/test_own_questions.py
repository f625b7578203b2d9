"""Suites of a user's own questions: from a table, and from pairs of pictures."""

from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image, ImageDraw
from typer.testing import CliRunner

from probe_kit.errors import SuiteError, UsageError
from probe_kit.suite import (
    PicturePair,
    Suite,
    Terms,
    load_suite,
    suite_from_csv,
    suite_from_pictures,
    validate_suite,
)
from probe_kit.suite.commands import app

TERMS = Terms("CC0-1.0", "nobody")
NEEDED = "instruction,correct,wrong"
FRUIT = ("yellow", "green", "red", "orange", "brown", "purple")


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Six fruit of one outline and six colours."""
    for colour in FRUIT:
        image = Image.new("RGB", (300, 260), "white")
        ImageDraw.Draw(image).ellipse((60, 40, 220, 200), fill=colour)
        image.save(tmp_path / f"{colour}.png")
    return tmp_path


def build_from_rows(folder: Path, *lines: str, header: str = "instruction,correct,wrong,group,category") -> Suite:
    table = folder / "fruit.csv"
    table.write_text("\n".join((header, *lines)), encoding="utf-8")
    return suite_from_csv(table, folder / "suite", terms=TERMS)


def test_a_six_picture_study_is_a_valid_suite(pictures: Path) -> None:
    suite = build_from_rows(
        pictures,
        "Put the cube on the ripe banana,yellow.png,green.png,banana,ripe-fruit",
        '"Put the cube on the apple, not the pear",red.png,orange.png,,ripe-fruit',
        "Move it onto plums,purple.png,brown.png,,ripe-fruit",
    )
    report = validate_suite(suite.folder)
    assert report.ok, report.to_text()
    assert not {finding.rule for finding in report.warnings} & {"W03", "W08"}  # colours tell them apart
    assert suite.name == "fruit"
    assert suite.categories == ("ripe-fruit",)
    assert [item.correct_side for item in suite.items] == ["left", "right", "left"]
    assert [item.object_phrase for item in suite.items] == ["ripe banana", "apple, not the pear", "plums"]
    assert [item.object_article for item in suite.items] == ["the", "the", "none"]
    for item, colour in zip(suite.items, ("yellow", "red", "purple"), strict=True):
        pixel = Image.open(item.picture(item.correct_side)).convert("RGB").getpixel((140, 130))
        assert pixel == Image.new("RGB", (1, 1), colour).getpixel((0, 0))


def test_questions_that_are_asked_both_ways_have_no_concept_that_is_always_right(pictures: Path) -> None:
    """The wrong picture is what its counterpart asks for, though the table names the correct one alone."""
    pairs = [(f"{kind}-1", f"{kind}-2") for kind in FRUIT]
    for number, name in enumerate(name for pair in pairs for name in pair):
        Image.new("RGB", (80, 80), (20 * number, 255 - 20 * number, 90)).save(pictures / f"{name}.png")
    lines = [
        f"Put the cube on the {kind},{correct}.png,{wrong}.png,,ripeness"
        for first, other in pairs
        for kind, correct, wrong in (("ripe fruit", first, other), ("unripe fruit", other, first))
    ]
    both = validate_suite(build_from_rows(pictures, *lines).folder)
    assert not [str(finding) for finding in both.warnings if finding.rule == "W02"]


def test_rows_of_a_group_or_with_a_common_picture_stay_together(pictures: Path) -> None:
    suite = build_from_rows(
        pictures,
        "Put the cube on the banana,yellow.png,green.png,kitchen,a",
        "Put the cube on the apple,red.png,orange.png,kitchen,a",
        "Put the cube on the plum,purple.png,brown.png,,a",
        "Put the cube on the fig,purple.png,green.png,,a",
    )
    groups = [item.group_id for item in suite.items]
    assert len(set(groups)) == 1  # green ties the fig to the banana, purple the plum to the fig
    apart = made_again(pictures)
    assert len({item.group_id for item in apart.items}) == 2


def made_again(pictures: Path) -> Suite:
    lines = (
        "Put the cube on the banana,yellow.png,green.png,kitchen",
        "Put the cube on the apple,red.png,orange.png,kitchen",
        "Put the cube on the plum,purple.png,brown.png,",
    )
    table = pictures / "again.csv"
    table.write_text("\n".join(("instruction,correct,wrong,group", *lines)), encoding="utf-8")
    return suite_from_csv(table, pictures / "again", category="b", terms=TERMS)


def test_two_rows_over_the_same_pictures_that_ask_the_other_way_round_are_twins(pictures: Path) -> None:
    suite = build_from_rows(
        pictures,
        "Put the cube on the banana,yellow.png,green.png",
        "Put the cube on the lime,green.png,yellow.png",
        header="instruction,correct,wrong",
    )
    first, other = suite.items
    assert first.pair_id == other.pair_id
    assert first.left_pixels_sha256 == other.left_pixels_sha256
    assert {first.correct_side, other.correct_side} == {"left", "right"}
    names = [(item.target_concept, item.distractor_concept) for item in suite.items]
    assert names == [("banana", "lime"), ("lime", "banana")], "a picture has one name, whichever is asked for"


@pytest.mark.parametrize(
    ("header", "line", "message"),
    [
        ("instruction,correct", "x,y", "line 1, lacks wrong; expected instruction, correct, wrong"),
        (f"{NEEDED},colour", "x,y,z,c", "line 1, has 'colour', which no table has; expected"),
        (NEEDED, "Put the cube on the lime,,green.png", "line 2, column correct: it is empty"),
        (NEEDED, "Put it on a lime, please,green.png,red.png", "line 2 has 4 fields, the heading has 3"),
        (NEEDED, "Banana!,yellow.png,green.png", "line 2, column instruction: no target can be parsed"),
        (f"{NEEDED},category", "Put it on a lime,green.png,red.png,mean", "line 2, column category: 'mean'"),
        (f"{NEEDED},category", "Put it on a lime,green.png,red.png,A/B", "line 2, column category: 'A/B' cannot"),
        (NEEDED, "", "no line below"),
    ],
)  # fmt: skip
def test_a_table_that_cannot_be_used_is_refused_by_its_line(
    header: str, line: str, message: str, pictures: Path
) -> None:
    with pytest.raises(UsageError, match=rf"fruit\.csv,? .*{message}|fruit\.csv, {message}"):
        build_from_rows(pictures, line, header=header)
    assert not (pictures / "suite").exists()


def test_the_same_question_twice_is_refused_with_both_lines(pictures: Path) -> None:
    line = "Put the cube on the banana,yellow.png,green.png,,"
    with pytest.raises(UsageError, match="lines 2 and 3"):
        build_from_rows(pictures, line, line)


def test_the_same_question_with_opposite_answers_is_refused_with_both_lines(pictures: Path) -> None:
    with pytest.raises(UsageError, match="lines 2 and 4 are the same question with opposite answers"):
        build_from_rows(
            pictures,
            "Put the cube on the banana,yellow.png,green.png",
            "Put the cube on the lime,green.png,yellow.png",
            "Put the cube on the banana,green.png,yellow.png",
            header=NEEDED,
        )


def test_groups_are_texts_as_they_are_written_and_missing_ones_are_no_group(pictures: Path) -> None:
    suite = build_from_rows(
        pictures,
        "Put the cube on the banana,yellow.png,green.png,5e882100,a",
        "Put the cube on the apple,red.png,orange.png,7e123400,a",
        "Put the cube on the plum,purple.png,brown.png,NA,a",
    )
    assert len({item.group_id for item in suite.items}) == 3, "two infinite numbers, and none"
    for group in ("007", "7.0", "-"):
        with pytest.raises(UsageError, match=r"fruit\.csv, line 3, column"):
            build_from_rows(
                pictures,
                "Put it on a lime,green.png,red.png,7,a",
                f"Put it on a plum,purple.png,brown.png,{group},a",
            )


def test_words_on_two_lines_are_two_words_and_a_heading_twice_is_refused(pictures: Path) -> None:
    suite = build_from_rows(
        pictures, '"Put the cube on the\nripe\u2028banana",yellow.png,green.png', header=NEEDED
    )
    assert suite.items[0].instruction == "Put the cube on the ripe banana"
    with pytest.raises(UsageError, match="line 1 has the column 'correct' twice"):
        build_from_rows(pictures, "Put it on a lime,green.png,red.png,brown.png", header=f"{NEEDED},correct")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("Put the cube on the lime,nowhere.png,red.png,,", "nowhere.png"),
        ("Put the cube on the left lime,green.png,red.png,,", "names a side"),
        ("Put the cube on the lime,green.png,green.png,,", "same picture"),
    ],
)
def test_a_question_that_breaks_a_rule_writes_nothing(line: str, message: str, pictures: Path) -> None:
    with pytest.raises(SuiteError, match=message):
        build_from_rows(pictures, line)
    assert not (pictures / "suite").exists()


@pytest.mark.parametrize(
    ("line", "column", "message"),
    [
        (
            "Put the cube on the lime,nowhere.png,red.png",
            "correct",
            "no picture nowhere.png in FOLDER. Paths",
        ),
        (
            "Put the cube on the lime,red.png,more/no.png",
            "wrong",
            "no picture more/no.png in FOLDER/more. Paths",
        ),
        ("Put the cube on the lime,/no/x.png,red.png", "correct", "no picture /no/x.png in /no. Paths"),
        ("Put the cube on the lime,red.png,text.png", "wrong", "FOLDER/text.png: not a picture that Pillow can"),
    ],
)
def test_a_picture_that_cannot_be_read_is_named_by_line_column_and_searched_folder(
    line: str, column: str, message: str, pictures: Path
) -> None:
    (pictures / "text.png").write_text("no picture", encoding="utf-8")
    with pytest.raises(SuiteError) as caught:
        build_from_rows(pictures, "Put the cube on the plum,purple.png,brown.png", line, header=NEEDED)
    printed = str(caught.value)
    assert printed.startswith(f"{pictures / 'fruit.csv'}, line 3, column {column}: ")
    assert message.replace("FOLDER", str(pictures)) in printed
    assert "build it again" not in printed, "there is no suite yet"


def test_a_question_that_breaks_a_rule_is_named_by_its_line(pictures: Path) -> None:
    with pytest.raises(SuiteError, match=r"fruit\.csv, line 3.*names a side"):
        build_from_rows(
            pictures,
            "Put the cube on the plum,purple.png,brown.png,,",
            "Put the cube on the left lime,green.png,red.png,,",
        )


def test_the_command_makes_the_suite_and_says_what_to_do_next(pictures: Path) -> None:
    table = pictures / "fruit.csv"
    table.write_text("instruction,correct,wrong\nPut the cube on the lime,green.png,red.png\n", encoding="utf-8")
    arguments = ["from-csv", str(table), "--out", str(pictures / "suite"), "--license", "CC0-1.0"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "1 item in 1 group" in result.output
    assert "suite validate" in result.output


def test_the_command_says_what_a_licence_is_for_when_there_is_none(pictures: Path) -> None:
    table = pictures / "fruit.csv"
    table.write_text("instruction,correct,wrong\nPut the cube on the lime,green.png,red.png\n", encoding="utf-8")
    result = CliRunner().invoke(app, ["from-csv", str(table), "--out", str(pictures / "suite")])
    assert result.exit_code != 0
    assert isinstance(result.exception, UsageError)
    assert "--license CC0-1.0" in str(result.exception)
    assert not (pictures / "suite").exists()


ABOUT = {"name": "mine", "license": "CC0-1.0", "attribution": "nobody"}
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
        PicturePair("color", f"{first} shape", discs[first], f"{other} shape", discs[other])
        for first, other in zip(COLOURS[::2], COLOURS[1::2], strict=True)
    ]


def test_every_pair_is_asked_both_ways_and_the_suite_is_valid(discs: dict[str, Path], tmp_path: Path) -> None:
    suite = suite_from_pictures(tmp_path / "mine", pairs_of(discs), **ABOUT)
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
        picture = Image.open(item.picture(item.correct_side)).convert("RGB")
        assert picture.size == (320, 320)
        assert picture.getpixel((140, 160)) == Image.new("RGB", (1, 1), colour).getpixel((0, 0))


def test_the_first_picture_lies_left_and_right_in_turn(discs: dict[str, Path], tmp_path: Path) -> None:
    suite = suite_from_pictures(tmp_path / "mine", pairs_of(discs), **ABOUT)
    side_of = {item.object_phrase: item.correct_side for item in suite.items}
    assert [side_of[f"{colour} shape"] for colour in COLOURS[::2]] == ["left", "right", "left"]


def test_pairs_that_share_a_picture_share_a_group(discs: dict[str, Path], tmp_path: Path) -> None:
    chain = [
        PicturePair("color", "red shape", discs["red"], "green shape", discs["green"]),
        PicturePair("color", "green shape", discs["green"], "blue shape", discs["blue"]),
        PicturePair("color", "brown shape", discs["brown"], "orange shape", discs["orange"]),
    ]
    suite = suite_from_pictures(tmp_path / "mine", chain, **ABOUT)
    groups = [item.group_id for item in suite.items]
    assert groups[0] == groups[1] == groups[2] == groups[3] != groups[4] == groups[5]


def test_the_same_pictures_give_the_same_suite_wherever_they_lie(discs: dict[str, Path], tmp_path: Path) -> None:
    first = suite_from_pictures(tmp_path / "one", pairs_of(discs), **ABOUT)
    other = suite_from_pictures(tmp_path / "other", pairs_of(discs), **ABOUT)
    assert first.identity == other.identity


def test_bad_pairs_are_refused_and_nothing_is_written(discs: dict[str, Path], tmp_path: Path) -> None:
    red, green = discs["red"], discs["green"]
    pair = PicturePair("color", "red shape", red, "green shape", green)
    turned = PicturePair("color", "green shape", green, "red shape", red)
    with pytest.raises(UsageError, match="at least one"):
        suite_from_pictures(tmp_path / "mine", [], **ABOUT)
    with pytest.raises(UsageError, match="twice"):
        suite_from_pictures(tmp_path / "mine", [pair, turned], **ABOUT)
    for name in ("mean", "all", "Colour", "a b", "-a", ""):
        with pytest.raises(UsageError, match="cannot name a category"):
            suite_from_pictures(tmp_path / "mine", [PicturePair(name, "a", red, "b", green)], **ABOUT)
    with pytest.raises(SuiteError, match="names a side"):
        suite_from_pictures(tmp_path / "mine", [PicturePair("color", "left one", red, "b", green)], **ABOUT)
    missing = PicturePair("color", "red shape", red, "green shape", tmp_path / "nothing.png")
    with pytest.raises(SuiteError, match=r"nothing\.png"):
        suite_from_pictures(tmp_path / "mine", [missing], **ABOUT)
    assert not (tmp_path / "mine").exists()


def test_a_category_of_ones_own_is_a_row_and_a_misspelt_one_is_pointed_out(
    discs: dict[str, Path], tmp_path: Path
) -> None:
    pair = PicturePair("ripe-fruit", "red one", discs["red"], "green one", discs["green"])
    suite = suite_from_pictures(tmp_path / "mine", [pair], **ABOUT)
    assert suite.categories == ("ripe-fruit",)
    assert load_suite(suite.folder).items == suite.items
    assert "Ripe fruit" in validate_suite(suite.folder).to_text()
    alone = suite_from_pictures(tmp_path / "alone", [replace(pair, category="colour")], **ABOUT)
    for built_suite in (suite, alone):
        report = validate_suite(built_suite.folder)
        assert report.missing == ()
        assert "Not in this suite" not in report.to_text()
        assert not [finding for finding in report.warnings if finding.rule == "W08"]
    shape_pair = PicturePair("shape", "red disc", discs["red"], "green disc", discs["green"])
    of_the_paper = suite_from_pictures(tmp_path / "shapes", [shape_pair], **ABOUT)
    assert "Not in this suite" not in validate_suite(of_the_paper.folder).to_text()
    both = [replace(pair, category="colour"), shape_pair]
    misspelt = suite_from_pictures(tmp_path / "other", both, **ABOUT)
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
    suite = suite_from_pictures(tmp_path / "mine", pairs, **ABOUT)
    lines = [str(finding) for finding in validate_suite(suite.folder).warnings if finding.rule == "W03"]
    assert lines
    assert len(lines) == len(set(lines))
