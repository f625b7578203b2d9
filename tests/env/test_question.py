from dataclasses import replace

import numpy as np
import pytest

from probe_kit.env.act2answer import Question
from probe_kit.errors import SceneError, SuiteError


def color(question, side):
    return question.pictures[side].getpixel((5, 5))


def test_the_original_layout_lays_the_pictures_as_the_item_says(item):
    question = Question.from_item(item, "original")
    assert (color(question, "left"), color(question, "right")) == ((255, 0, 0), (0, 255, 255))
    assert question.side_correct == "left"


def test_the_swapped_layout_exchanges_pictures_and_correct_side(item):
    question = Question.from_item(item, "swapped")
    assert (color(question, "left"), color(question, "right")) == ((0, 255, 255), (255, 0, 0))
    assert question.side_correct == "right"
    assert question.name == "color-0001:s"


def test_a_missing_picture_is_named(item):
    (item.folder / "cyan.png").unlink()
    with pytest.raises(SuiteError, match=r"cyan\.png"):
        Question.from_item(item, "original")


@pytest.mark.parametrize("rubbish", [b"", b"not a picture", b"\x89PNG\r\n\x1a\n" + bytes(60)])
def test_a_corrupt_picture_is_refused(item, rubbish):
    (item.folder / "red.png").write_bytes(rubbish)
    with pytest.raises(SuiteError, match=r"red\.png"):
        Question.from_item(item, "original")


def test_a_truncated_picture_is_refused(item):
    from PIL import Image

    noise = np.random.default_rng(0).integers(0, 255, (40, 40, 3), np.uint8)
    Image.fromarray(noise).save(item.folder / "red.png")
    whole = (item.folder / "red.png").read_bytes()
    (item.folder / "red.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SuiteError, match=r"red\.png"):
        Question.from_item(item, "original")


@pytest.mark.parametrize(("mode", "ink"), [("L", 90), ("RGBA", (9, 9, 9, 0)), ("P", 3)])
def test_pictures_of_other_modes_and_odd_names_become_rgb(item, mode, ink):
    from PIL import Image

    Image.new(mode, (30, 50), ink).save(item.folder / "größe ü.png")
    question = Question.from_item(replace(item, left_file_name="größe ü.png"), "original")
    assert question.pictures["left"].mode == "RGB"
    assert question.pictures["left"].size == (50, 50)


def test_an_unknown_layout_is_refused(item):
    with pytest.raises(SceneError, match="original, swapped"):
        Question.from_item(item, "mirrored")
    with pytest.raises(SceneError, match="original, swapped"):
        Question.built_in("mirrored")


def test_the_built_in_question_swaps_too():
    assert Question.built_in("original").side_correct == "left"
    assert Question.built_in("swapped").side_correct == "right"
    assert color(Question.built_in("swapped"), "right") == color(Question.built_in("original"), "left")


def test_a_picture_with_other_pixels_than_the_item_says_is_refused(item):
    """A suite is named after its pixels: a file exchanged together with its own hash would keep that name."""
    with pytest.raises(SuiteError, match=r"red\.png: has other pixels than its suite says"):
        Question.from_item(replace(item, left_pixels_sha256="ab" * 32), "original")
    with pytest.raises(SuiteError, match=r"red\.png: has other pixels"):
        Question.from_item(replace(item, left_pixels_sha256="ab" * 32), "swapped")
